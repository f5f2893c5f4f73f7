"""A page that shows stylised runs: the photos, the painting, the scene before and after, and how it was made.

The page is one HTML file that needs nothing else: pictures and videos lie inside it as data URIs, so that it opens
without a network and can be sent as it is. `collect_run` gets a run's pictures through nerfstudio; `page_html` and
`write_page` know nothing of nerfstudio, only of pictures.
"""

import base64
import io
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageOps

from sparsestyle_ns.errors import InputError
from sparsestyle_ns.output_file import prepare_output, write_output
from sparsestyle_ns.page import html_page
from sparsestyle_ns.run_folder import STYLE_METHOD, find_config, load_run

LONGEST_SIDE = 512
"""Pixels that a picture on the page has at most along its longer side."""
LOSSLESS_PIXELS = 200_000
"""Pictures with at most this many pixels go into the page as PNG, larger ones as JPEG."""

EXAMPLE_NAME = "index.html"
"""A good name for a page."""

Pixels = UInt8[np.ndarray, "H W 3"]


@dataclass
class Picture:
    """A picture with its caption."""

    pixels: Pixels
    caption: str


@dataclass
class View:
    """One viewpoint of a run, all pictures of the same size.

    Attributes:
        name: what kind of view it is and which.
        stylised: the stylised render.
        coarse: the render before stylising.
        photo: the photo taken there, where there is one.
        depth: the stylised scene's depth, as a picture.
    """

    name: str
    stylised: Pixels
    coarse: Pixels
    photo: Optional[Pixels] = None
    depth: Optional[Pixels] = None


@dataclass
class RunPictures:
    """All that the page shows of one run.

    Attributes:
        name: the scene's name, the section's heading.
        subtitle: a line on how it was made.
        photos: the photos it was trained on.
        views: viewpoints, the first of them shown large; at least one.
        style: the style image; None where its file is gone.
        style_note: said in its place.
        video: an MP4 file's bytes.
        figures: (label, value) of measurements.
        settings: (label, value) of how the run was made.
        effects: lines of the table of effects, the first of them its heading.
    """

    name: str
    subtitle: str
    photos: List[Picture]
    views: List[View]
    style: Optional[Picture] = None
    style_note: str = "The style image is no longer where it was."
    video: Optional[bytes] = None
    figures: List[Tuple[str, str]] = field(default_factory=list)
    settings: List[Tuple[str, str]] = field(default_factory=list)
    effects: List[Tuple[str, ...]] = field(default_factory=list)


# ---------------------------------------------------------------------------------------------------------- the page


def write_page(runs: Sequence[RunPictures], output_path: Path, title: str) -> Path:
    """Writes the page; the file appears under its name only when it is whole.

    Args:
        runs: what to show, in this order.
        output_path: the file; folders on the way to it are made.
        title: the page's heading, plain text.

    Returns:
        The file's absolute path.

    Raises:
        InputError: it can't be written there.
    """
    return write_document(page_html(runs, title), output_path)


def write_document(page: str, output_path: Path) -> Path:
    """Writes a whole HTML page as `write_page` does."""
    return write_output(output_path, page.encode(), "The page", EXAMPLE_NAME)


def prepare_folder(output_path: Path) -> None:
    """Makes the folder that a page is to be written to.

    Raises:
        InputError: it can't be made or written to, or the page's name is that of a folder.
    """
    prepare_output(output_path, "The page", EXAMPLE_NAME)


def page_html(runs: Sequence[RunPictures], title: str) -> str:
    """The whole page as HTML."""
    contents = "" if len(runs) < 2 else _contents(runs)
    sections = "".join(_section(run, f"run-{number}") for number, run in enumerate(runs, start=1))
    return document(title, contents, sections)


def document(title: str, contents: str, sections: str) -> str:
    """A page in this package's style that needs nothing else.

    Args:
        title: its heading, plain text.
        contents: HTML below the heading.
        sections: HTML of its body.
    """
    body = (
        f'<header class="top"><h1>{escape(title)}</h1>{contents}</header>\n'
        f"<main>\n{sections}</main>\n<script>{SCRIPT}</script>"
    )
    return html_page(title, STYLE_SHEET, body)


def data_uri(pixels: Pixels) -> str:
    """A picture as a data URI: PNG, or JPEG where PNG would be heavy."""
    lossless = pixels.shape[0] * pixels.shape[1] <= LOSSLESS_PIXELS
    buffer = io.BytesIO()
    if lossless:
        Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    else:
        Image.fromarray(pixels).save(buffer, "JPEG", quality=90)
    return f"data:image/{'png' if lossless else 'jpeg'};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _contents(runs: Sequence[RunPictures]) -> str:
    links = "".join(f'<a href="#run-{i}">{escape(run.name)}</a>' for i, run in enumerate(runs, start=1))
    return f'<nav aria-label="Runs">{links}</nav>'


def _section(run: RunPictures, anchor: str) -> str:
    return (
        f'<section class="run" id="{anchor}" aria-labelledby="{anchor}-name">\n'
        f'<div class="heading"><h2 id="{anchor}-name">{escape(run.name)}</h2><p>{escape(run.subtitle)}</p></div>\n'
        f'<div class="stage">{_comparison(run.views[0])}{_video(run.video)}</div>\n'
        f"{_sources(run)}{_views(run.views)}{_facts(run)}</section>\n"
    )


def _image(pixels: Pixels, alternative: str, name: str = "") -> str:
    height, width = pixels.shape[:2]
    names = f' class="{name}"' if name else ""
    return f'<img{names} src="{data_uri(pixels)}" width="{width}" height="{height}" alt="{escape(alternative)}">'


def figure(pixels: Pixels, caption: str, alternative: Optional[str] = None) -> str:
    """A picture with its caption, as HTML; both texts are plain."""
    return f"<figure>{_image(pixels, alternative or caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def _comparison(view: View) -> str:
    """The slider between the coarse and the stylised render; without scripts, half of each."""
    return (
        '<figure><div class="compare">'
        f"{_image(view.stylised, f'{view.name}, stylised')}{_image(view.coarse, f'{view.name}, coarse', 'before')}"
        '<span class="tag left">Before</span><span class="tag right">After</span>'
        '<span class="handle" aria-hidden="true"></span>'
        '<input type="range" min="0" max="100" step="1" value="50" aria-label="Share of the coarse render in percent">'
        f"</div><figcaption>{escape(view.name)}, coarse and stylised. Drag to compare.</figcaption></figure>"
    )


def _video(video: Optional[bytes]) -> str:
    if video is None:
        return ""
    return (
        '<figure><video autoplay loop muted playsinline controls aria-label="Flight through the stylised scene" '
        f'src="data:video/mp4;base64,{base64.b64encode(video).decode()}"></video>'
        "<figcaption>A flight through the stylised scene.</figcaption></figure>"
    )


def _sources(run: RunPictures) -> str:
    photos = "".join(figure(photo.pixels, photo.caption) for photo in run.photos)
    if run.style is None:
        style = f'<p class="note">{escape(run.style_note)}</p>'
    else:
        style = figure(run.style.pixels, run.style.caption)
    columns = 4 if len(run.photos) in (4, 7, 8) else 3
    count = "One photo" if len(run.photos) == 1 else f"{len(run.photos)} photos"
    return (
        '<div class="sources">'
        f'<div class="photos"><h3>{count}</h3><div class="strip" style="--columns: {columns}">{photos}</div></div>'
        '<span class="plus" aria-hidden="true">+</span>'
        f'<div class="painting"><h3>One painting</h3><div class="strip">{style}</div></div></div>\n'
    )


def _views(views: Sequence[View]) -> str:
    """A contact sheet: a row a view, the columns photo, coarse, stylised, depth."""
    rows, columns = [], set()
    for view in views:
        cells = {"Photo": view.photo, "Coarse": view.coarse, "Stylised": view.stylised, "Depth": view.depth}
        there = {caption: pixels for caption, pixels in cells.items() if pixels is not None}
        columns.add(tuple(there))
        figures = "".join(figure(pixels, caption, f"{caption}, {view.name}") for caption, pixels in there.items())
        rows.append(f'<div class="view"><h4>{escape(view.name)}</h4><div class="cells">{figures}</div></div>')
    names = "views aligned" if len(columns) == 1 else "views"
    return f'<div class="{names}"><h3>From other viewpoints</h3>{"".join(rows)}</div>\n'


def _facts(run: RunPictures) -> str:
    return (
        '<div class="facts">'
        + _definitions("Measured", "figures", run.figures)
        + _definitions("Settings", "settings", run.settings)
        + _table("Effects", "effects", run.effects)
        + "</div>"
    )


def _table(heading: str, name: str, rows: Sequence[Tuple[str, ...]]) -> str:
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    return (
        f'<div class="{name}"><h3>{heading}</h3><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div></div>\n"
    )


def _definitions(heading: str, name: str, entries: Sequence[Tuple[str, str]]) -> str:
    if not entries:
        return ""
    pairs = "".join(f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in entries)
    return f'<div class="{name}"><h3>{heading}</h3><dl>{pairs}</dl></div>\n'


STYLE_SHEET = """
.run { border-top: 1px solid var(--line); padding-top: 1.5rem; }
.run + .run { margin-top: clamp(3.5rem, 8vw, 6rem); }
.heading { display: flex; flex-wrap: wrap; align-items: baseline; gap: 0.25rem 1.25rem; margin-bottom: 1.5rem; }
.heading p, figcaption, .note { color: var(--soft); }
.heading p { font-size: 0.9375rem; }
figcaption { font-size: 0.8125rem; margin-top: 0.5rem; overflow-wrap: anywhere; }
img, video { display: block; width: 100%; height: auto; border-radius: 0.375rem; background: var(--line); }
.stage { display: grid; gap: 1.5rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
.stage > :only-child { max-width: 56rem; }
.compare {
  --at: 50%; position: relative; overflow: hidden; border-radius: 0.375rem; cursor: ew-resize;
  touch-action: pan-y; user-select: none; -webkit-user-select: none;
}
.compare img { pointer-events: none; }
.compare .before { position: absolute; inset: 0; height: 100%; clip-path: inset(0 calc(100% - var(--at)) 0 0); }
.compare .handle {
  position: absolute; inset: 0 auto 0 var(--at); width: 2px; margin-left: -1px; background: #fff;
  box-shadow: 0 0 0 0.5px rgb(0 0 0 / 0.3); pointer-events: none;
}
.compare .handle::after {
  content: "\\2039\\2009\\203A"; position: absolute; top: 50%; left: 50%; translate: -50% -50%;
  width: 2.5rem; height: 2.5rem; border-radius: 50%; display: grid; place-items: center;
  background: #fff; color: #1d1c1a; font: 600 1.25rem/1 var(--sans); padding-bottom: 0.15rem;
  box-shadow: 0 1px 6px rgb(0 0 0 / 0.35);
}
.compare input { position: absolute; inset: 0; width: 100%; height: 100%; opacity: 0; pointer-events: none; }
.compare:has(input:focus-visible) { outline: 3px solid var(--accent); outline-offset: 2px; }
.tag {
  position: absolute; bottom: 0.75rem; padding: 0.15rem 0.6rem; border-radius: 1rem; pointer-events: none;
  background: rgb(0 0 0 / 0.55); color: #fff; font-size: 0.75rem; font-weight: 500;
}
.tag.left { left: 0.75rem; }
.tag.right { right: 0.75rem; }
.sources, .views, .facts { margin-top: clamp(2rem, 5vw, 3rem); }
.sources { display: flex; gap: 1.25rem; }
.photos { flex: 3 1 0; min-width: 0; }
.painting { flex: 1 1 0; min-width: 0; }
.painting img { width: auto; max-width: 100%; max-height: 22rem; }
.plus { font: 300 2rem/1 var(--sans); color: var(--soft); align-self: center; }
.strip { display: grid; gap: 1rem; grid-template-columns: repeat(var(--columns, 1), minmax(0, 1fr)); }
.note { border: 1px dashed var(--line); border-radius: 0.375rem; padding: 1.25rem; font-size: 0.875rem; }
.view + .view { margin-top: 1.25rem; }
.cells { display: grid; gap: 1rem; grid-auto-flow: column; grid-auto-columns: minmax(0, 1fr); }
.facts { display: grid; gap: clamp(2rem, 4vw, 3rem); }
dl { display: grid; gap: 1rem 2rem; }
dl > div { border-top: 1px solid var(--line); padding-top: 0.5rem; }
dt { font-size: 0.8125rem; color: var(--soft); }
dd { overflow-wrap: anywhere; }
.figures dl { grid-template-columns: repeat(auto-fill, minmax(10rem, 1fr)); }
.figures dd { font-family: var(--serif); font-size: 1.75rem; line-height: 1.25; font-variant-numeric: lining-nums; }
.settings dl { grid-template-columns: repeat(auto-fill, minmax(14rem, 1fr)); }
.settings dd { font-size: 0.9375rem; }
.scroll { overflow-x: auto; margin: 0.75rem 0 1.5rem; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: 0.35rem 0.9rem 0.35rem 0; text-align: right; }
th:first-child, td:first-child { text-align: left; }
th { color: var(--soft); font-weight: 500; }
tr.cited td { color: var(--soft); font-style: italic; }
.plot img { background: #fff; max-width: 46rem; }
.effects table { width: 100%; }
.effects th, .effects td { text-align: left; }
@media (max-width: 46rem) {
  .sources { flex-direction: column; align-items: stretch; gap: 1rem; }
  .photos, .painting { flex: none; }
  .plus { align-self: flex-start; margin: -0.25rem 0; }
  .strip { gap: 0.5rem; }
  .painting img { max-height: 15rem; }
  .cells { gap: 0.75rem; grid-auto-flow: row; grid-template-columns: 1fr 1fr; }
  .figures dl, .settings dl { grid-template-columns: 1fr 1fr; gap: 0.75rem 1rem; }
}
@media (min-width: 46.01rem) {
  .aligned .view:first-of-type figure { display: flex; flex-direction: column-reverse; justify-content: flex-end; }
  .aligned .view:first-of-type figcaption { margin: 0 0 0.375rem; }
  .aligned .view + .view figcaption { display: none; }
}
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
"""

SCRIPT = """
for (const slider of document.querySelectorAll(".compare")) {
  const range = slider.querySelector("input");
  const show = () => slider.style.setProperty("--at", range.value + "%");
  const follow = (event) => {
    const box = slider.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    show();
  };
  slider.addEventListener("pointerdown", (event) => { slider.setPointerCapture(event.pointerId); follow(event); });
  slider.addEventListener("pointermove", (event) => { if (event.buttons) follow(event); });
  range.addEventListener("input", show);
  show();
}
if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
  for (const video of document.querySelectorAll("video")) { video.autoplay = false; video.pause(); }
}
"""


# --------------------------------------------------------------------------------------------------- a run's pictures


def read_video(path: Path) -> bytes:
    """An MP4 file's bytes.

    Raises:
        InputError: it can't be read or is no MP4.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"The video {path} can't be read ({error.strerror}).") from error
    if content[4:8] != b"ftyp":
        raise InputError(f"{path} is no MP4 video; give one that ns-render wrote.")
    return content


def collect_run(config_path: Path, video: Optional[Path] = None, num_views: int = 3) -> RunPictures:
    """Loads a stylised run and renders what the page shows of it.

    Args:
        config_path: the run's config.yml, or its folder. The run may have been moved since it was made.
        video: an MP4 file to show beside it.
        num_views: held-out views to render, evenly spaced; fewer where there are fewer.

    Raises:
        InputError: it isn't a finished run of this package, its photos are gone, or the video can't be read.
    """
    config_path = find_config(config_path, STYLE_METHOD)
    content = None if video is None else read_video(video)
    if num_views < 1:
        raise InputError(f"--num-views is {num_views}; at least one view is needed.")
    config, pipeline, step = load_run(config_path)
    dataset, held_out = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
    photos = [
        Picture(_photo(dataset, index), path.name)
        for index, path in enumerate(dataset._dataparser_outputs.image_filenames)
    ]
    views, measured = _render_views(pipeline, held_out, num_views)
    style = _style_picture(config.pipeline.style_image)
    return RunPictures(
        name=Path(config.experiment_name).name,
        subtitle=f"{config.method_name}, {len(photos)} photos, {step + 1} iterations",
        photos=photos,
        views=views,
        style=style,
        style_note=f"The style image, {config.pipeline.style_image}, is no longer there.",
        video=content,
        figures=_figures(measured),
        settings=_settings(config, dataset, step),
        effects=pipeline.effects.rows(),
    )


def _render_views(pipeline: Any, dataset: Any, num_views: int) -> Tuple[List[View], List[Dict[str, float]]]:
    """Held-out views with their photos, and what the model measures of each."""
    import torch

    from sparsestyle_ns.view_selection import evenly_spaced

    trained = set(pipeline.datamanager.train_dataset._dataparser_outputs.image_filenames)
    views, measured = [], []
    for index in evenly_spaced(len(dataset), min(num_views, len(dataset))):
        path = dataset._dataparser_outputs.image_filenames[index]
        photo = _photo(dataset, index)
        height, width = photo.shape[:2]
        camera = dataset.cameras[index : index + 1].to(pipeline.device)
        camera.rescale_output_resolution(width / camera.width.item())
        camera.height.fill_(height)
        with torch.no_grad():
            outputs = pipeline.model.get_outputs_for_camera(camera)
            metrics, _ = pipeline.model.get_image_metrics_and_images(
                outputs, {"image": torch.from_numpy(photo).to(pipeline.device) / 255.0}
            )
        measured.append(metrics)
        views.append(
            View(
                name=f"{'Training view' if path in trained else 'Held-out view'} {path.name}",
                stylised=_bytes(outputs["rgb"].cpu().numpy()),
                coarse=_bytes(outputs["rgb_coarse"].cpu().numpy()),
                photo=photo,
                depth=depth_picture(outputs["depth"].cpu().numpy(), outputs["accumulation"].cpu().numpy()),
            )
        )
    return views, measured


def depth_picture(depth: Float[np.ndarray, "H W 1"], accumulation: Float[np.ndarray, "H W 1"]) -> Pixels:
    """Depth as shades, near light and far dark, with the background in the middle grey of nothing.

    The shade is linear in 1 / depth, between the 2nd and the 98th percentile of what is seen, so that a far wall
    doesn't take all shades from the things before it.
    """
    nearness = 1.0 / np.maximum(depth[..., 0], 1e-6)
    weight = np.clip(accumulation, 0.0, 1.0)
    seen = nearness[weight[..., 0] > 0.5]
    far, near = np.percentile(seen, (2, 98)) if seen.size else (0.0, 1.0)
    share = np.clip((nearness - far) / max(near - far, 1e-9), 0.0, 1.0)[..., None]
    dark, light = np.array([0.10, 0.13, 0.22]), np.array([0.98, 0.93, 0.82])
    middle = np.array([0.72, 0.38, 0.30])
    shade = np.where(share < 0.5, dark + (middle - dark) * 2 * share, middle + (light - middle) * (2 * share - 1))
    return _bytes(shade * weight + 0.5 * (1.0 - weight))


def _bytes(image: Float[np.ndarray, "H W 3"]) -> Pixels:
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def _photo(dataset: Any, index: int) -> Pixels:
    """A photo of a dataset at the size of its file, where the run was trained on a smaller one; at most 512 pixels."""
    scale, dataset.scale_factor = dataset.scale_factor, 1.0
    try:
        pixels = dataset.get_image_uint8(index)[..., :3].numpy()
    finally:
        dataset.scale_factor = scale
    return _fitted(Image.fromarray(pixels))


def _fitted(image: Image.Image) -> Pixels:
    image.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.LANCZOS)
    return np.array(image)


def _style_picture(path: Optional[Path]) -> Optional[Picture]:
    if path is None:
        return None
    try:
        with Image.open(path) as image:
            return Picture(_fitted(ImageOps.exif_transpose(image).convert("RGB")), path.name)
    except OSError:  # also what Pillow raises for what isn't a picture
        return None


FIGURE_LABELS = {
    "coarse_psnr": ("Coarse PSNR", "{:.2f} dB"),
    "coarse_ssim": ("Coarse SSIM", "{:.3f}"),
    "coarse_lpips": ("Coarse LPIPS", "{:.3f}"),
    "content_ssim": ("Stylised SSIM to photo", "{:.3f}"),
}


def _figures(measured: Sequence[Dict[str, float]]) -> List[Tuple[str, str]]:
    """Means over the views of what the model measured, and over how many."""
    figures = []
    for key, (label, form) in FIGURE_LABELS.items():
        values = [metrics[key] for metrics in measured if key in metrics]
        if values:
            figures.append((label, form.format(sum(values) / len(values))))
    if figures:
        figures.append(("Mean of", f"{len(measured)} view" + "s" * (len(measured) > 1)))
    return figures


def _settings(config: Any, dataset: Any, step: int) -> List[Tuple[str, str]]:
    pipeline = config.pipeline
    height, width = int(dataset.cameras.height[0]), int(dataset.cameras.width[0])
    return [
        ("Method", config.method_name),
        ("Made", config.timestamp),
        ("Views trained on", ", ".join(map(str, dataset.metadata["view_ids"]))),
        ("Photo size in training", f"{width} × {height} pixels"),
        ("Iterations", f"{step + 1} of {config.max_num_iterations}"),
        ("Coarse run", "none" if pipeline.coarse_run is None else pipeline.coarse_run.name),
        ("Style image", "none" if pipeline.style_image is None else pipeline.style_image.name),
        ("Feature network", pipeline.backbone if pipeline.vgg_weights is None else pipeline.vgg_weights.name),
        ("Size it sees views at", f"{pipeline.feature_side} pixels"),
        (
            "Content weight λ",
            f"{pipeline.content_weight:g} to {pipeline.content_weight * pipeline.content_decay:g} in "
            f"{pipeline.content_steps} iterations",
        ),
        ("Warm start", f"{pipeline.warm_start_steps} steps"),
    ]
