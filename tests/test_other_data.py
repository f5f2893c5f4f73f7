"""A run and the data that it was trained on: found wherever both are now, and never taken for another's."""

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Callable, Dict, List

import numpy as np
import pytest
import torch
import yaml
from conftest import TINY, TINY_STYLE, ns_train, only_run, run_entrypoint
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from test_commands import write_ring, write_transforms

from sparsestyle_ns.cli import main
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.engine.hints import after_evaluation
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import saved_report
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.runs.checkpoints import newest_checkpoint
from sparsestyle_ns.runs.scene_record import RECORD_FILE, ExpectedScene, SceneRecord, record_scene
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.utils.errors import InputError

pytestmark = pytest.mark.usefixtures("quick_reports")


@pytest.fixture
def project(runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path) -> SimpleNamespace:
    """A project folder with a scene, a painting, and a coarse and a stylised run of them, as if trained there."""
    root = tmp_path / "project"
    copied = {
        runs.outputs.resolve(): shutil.copytree(runs.outputs, root / "outputs"),
        llff_scene.resolve(): shutil.copytree(llff_scene, root / "data" / "llff"),
        painting.resolve(): Path(shutil.copy(painting, root / "painting.png")),
    }
    found = SimpleNamespace(root=root, scene=root / "data" / "llff", painting=root / "painting.png")
    for name in ("coarse", "style"):
        run = root / "outputs" / getattr(runs, name).relative_to(runs.outputs)
        setattr(found, name, run)
        config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
        config.output_dir, manager = copied[runs.outputs.resolve()], config.pipeline.datamanager
        config.data = manager.data = manager.dataparser.data = copied[llff_scene.resolve()]
        if name == "style":
            config.pipeline.style_image, config.pipeline.coarse_run = found.painting, found.coarse
        (run / "config.yml").write_text(yaml.dump(config))
        record = json.loads((run / RECORD_FILE).read_text())
        (run / RECORD_FILE).write_text(json.dumps({**record, "data": str(found.scene), "folder": str(run)}))
    return found


def add_photo(scene: Path) -> None:
    """One more photo, with its pose, which comes first: the numbers of all others shift."""
    shutil.copy(scene / "images" / "image003.png", scene / "images" / "added.png")
    poses = np.load(scene / "poses_bounds.npy")
    np.save(scene / "poses_bounds.npy", poses[[3, *range(len(poses))]])


def take_photo_away(scene: Path) -> None:
    (scene / "images" / "image011.png").unlink()
    np.save(scene / "poses_bounds.npy", np.load(scene / "poses_bounds.npy")[:-1])


def rename_photo(scene: Path) -> None:
    (scene / "images" / "image005.png").rename(scene / "images" / "image005b.png")


def change_photo(scene: Path, name: str = "image005.png") -> None:
    with Image.open(scene / "images" / name) as photo:
        pixels = np.asarray(photo).copy()
    pixels[:4] = 255 - pixels[:4]
    Image.fromarray(pixels).save(scene / "images" / name)


def change_held_out_photo(scene: Path) -> None:
    change_photo(scene, "image008.png")


def move_camera(scene: Path) -> None:
    poses = np.load(scene / "poses_bounds.npy")
    poses[5, 3] += 0.5
    np.save(scene / "poses_bounds.npy", poses)


def replace_scene(scene: Path) -> None:
    import make_sample_scene

    shutil.rmtree(scene)
    make_sample_scene.main([str(scene.parent), "--layout", "llff", "--width", "32", "--num-views", "12", "--seed", "2"])


CHANGES: Dict[str, Callable[[Path], None]] = {
    "a photo was added": add_photo,
    "a photo was taken away": take_photo_away,
    "a photo was renamed": rename_photo,
    "a training photo was changed": change_photo,
    "a held-out photo was changed": change_held_out_photo,
    "a camera was moved": move_camera,
    "another scene took its place": replace_scene,
}
change_by_name = pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)


def files_below(folder: Path) -> Dict[Path, bytes]:
    """Their contents, but for what a training in this process may still write for tensorboard."""
    files = (path for path in folder.rglob("*") if path.is_file() and "tfevents" not in path.name)
    return {path: path.read_bytes() for path in files}


def refused(arguments: List[str]) -> str:
    """The sentence with which a `sparsestyle` command ends."""
    with pytest.raises(SystemExit) as ended:
        main([str(part) for part in arguments])
    message = str(ended.value.code)
    assert message.startswith("Error: ") and message.count("\n") == 0
    return message


def ns_command(name: str, *arguments: object) -> None:
    """One of nerfstudio's commands that open runs."""
    from nerfstudio.scripts import eval as ns_eval
    from nerfstudio.scripts import render

    run_entrypoint({"ns-eval": ns_eval, "ns-render": render}[name].entrypoint, [str(part) for part in arguments])


@change_by_name
def test_a_run_isnt_opened_with_another_scene(project: SimpleNamespace, change: Callable[[Path], None]) -> None:
    before = files_below(project.coarse)
    change(project.scene)
    message = refused(["evaluate", project.coarse])
    assert f"The run {project.coarse} doesn't fit {project.scene} as it is now (" in message
    assert files_below(project.coarse) == before


def test_no_command_opens_a_run_with_another_scene(project: SimpleNamespace, tmp_path: Path) -> None:
    """Also a film needs photos of which the run is: they tell the cameras."""
    add_photo(project.scene)
    config, output = project.style / "config.yml", tmp_path / "output"
    for arguments in (
        ["evaluate", project.style],
        ["gallery", project.style, "--output-path", output],
        ["export", project.style, "--output-path", output],
    ):
        assert "doesn't fit" in refused(arguments)
    for name, *arguments in (
        ("ns-eval", "--load-config", config, "--output-path", tmp_path / "a.json"),
        ("ns-render", "interpolate", "--load-config", config, "--output-path", output),
        ("ns-render", "dataset", "--load-config", config, "--output-path", output),
        ("ns-render", "spiral", "--load-config", config, "--output-path", output),
    ):
        with pytest.raises(SystemExit, match="doesn't fit"):
            ns_command(name, *arguments)
    assert not output.exists()


def test_a_run_on_a_relative_path_is_measured_on_its_own_scene_from_everywhere(
    project: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = shutil.copytree(project.scene, tmp_path / "other" / "data" / "llff")
    replace_scene(other)
    monkeypatch.chdir(project.root)
    ns_train("coarse-fewshot", Path("data/llff"), project.root / "outputs" / "new", "--max-num-iterations", "1", *TINY)
    run = only_run(project.root / "outputs" / "new", "coarse-fewshot")
    as_before = shutil.copytree(run, run.with_name("earlier"))
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    config.data = config.pipeline.datamanager.data = Path("data/llff")  # so earlier versions wrote it
    (as_before / "config.yml").write_text(yaml.dump(config))
    reports = []
    for folder, place in ((run, project.root), (run, tmp_path / "other"), (as_before, tmp_path / "other")):
        monkeypatch.chdir(place)
        main(["evaluate", str(folder), "--output-path", str(tmp_path / "report.json"), "--force"])
        reports.append(json.loads((tmp_path / "report.json").read_text())["results"])
    assert reports[0] == reports[1] == reports[2]


def test_every_tool_reads_the_run_that_was_named_after_a_project_has_moved(
    project: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it was before there is another state of it by now, and other photos."""
    moved = shutil.copytree(project.root, tmp_path / "deeper" / "down" / "moved")
    checkpoint = newest_checkpoint(project.coarse / "nerfstudio_models")
    state = torch.load(checkpoint, weights_only=True)
    state["pipeline"]["_model.field.density_head.bias"].fill_(9.0)
    torch.save(state, checkpoint)
    replace_scene(project.scene)
    monkeypatch.chdir(tmp_path)
    run = moved / project.coarse.relative_to(project.root)
    _, pipeline, _ = load_run(run / "config.yml")
    assert pipeline.datamanager.config.data == moved / "data" / "llff"
    main(["evaluate", str(run), "--output-path", str(tmp_path / "ours.json")])
    ns_command("ns-eval", "--load-config", run / "config.yml", "--output-path", tmp_path / "theirs.json")
    ours, theirs = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("ours", "theirs"))
    assert theirs["checkpoint"] == str(run / "nerfstudio_models" / checkpoint.name)
    assert ours["results"].items() <= theirs["results"].items()
    command = after_evaluation(run, stylised=False)
    assert command[command.index("--data") + 1] == str(moved / "data" / "llff") and "--output-dir" not in command
    _, pipeline, _ = load_run(moved / project.style.relative_to(project.root) / "config.yml")
    assert pipeline.config.style_image == moved / "painting.png"


def test_a_run_that_lies_at_the_root_of_a_disk_opens(project: SimpleNamespace, tmp_path: Path) -> None:
    """Folders around it needn't be those that ns-train makes."""
    flat = shutil.copytree(project.coarse, tmp_path / "flat")
    config, pipeline, _ = load_run(flat / "config.yml")
    assert config.method_name == "coarse-fewshot" and config.get_base_dir() == flat
    assert pipeline.datamanager.config.data == project.scene


def test_what_is_said_of_a_scene_that_moved_alone_can_be_done(
    project: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    elsewhere = project.scene.rename(tmp_path / "elsewhere")
    message = refused(["evaluate", project.coarse])
    record = project.coarse / RECORD_FILE
    assert message.endswith(f'put it back there, or write where it is now behind "data" in {record}.')
    with pytest.raises(SystemExit, match='behind "data" in'):
        ns_command("ns-eval", "--load-config", project.coarse / "config.yml", "--output-path", tmp_path / "a.json")
    record.write_text(json.dumps({**json.loads(record.read_text()), "data": str(elsewhere)}))
    main(["evaluate", str(project.coarse)])
    assert capsys.readouterr().out.rstrip().endswith(f"--data {elsewhere} llff-data")
    ns_command("ns-eval", "--load-config", project.coarse / "config.yml", "--output-path", tmp_path / "a.json")
    ns_command(
        *("ns-render", "dataset", "--load-config", project.coarse / "config.yml", "--data", elsewhere),
        *("--output-path", tmp_path / "pictures", "--rendered-output-names", "rgb"),
    )
    assert len(list((tmp_path / "pictures").rglob("*.jpg"))) == 2


@pytest.mark.parametrize("content", ["", "[]", '{"data": 1}', None], ids=["empty", "a list", "other keys", "missing"])
def test_a_damaged_record_is_named(project: SimpleNamespace, content: str) -> None:
    record = project.coarse / RECORD_FILE
    record.unlink() if content is None else record.write_text(content)
    assert f"{record} is missing or damaged" in refused(["evaluate", project.coarse])


def resume(project: SimpleNamespace, method: str, *flags: str, parser: str = "llff-data") -> None:
    run = project.coarse if method == "coarse-fewshot" else project.style
    small = TINY if method == "coarse-fewshot" else [*TINY_STYLE, "--style-image", str(project.painting)]
    flags = ["--load-dir", str(run / "nerfstudio_models"), "--max-num-iterations", "4", *small, *flags]
    ns_train(method, project.scene, project.root / "more", *flags, parser=parser)


@pytest.mark.parametrize("change", [add_photo, rename_photo, change_photo, move_camera, replace_scene])
def test_training_goes_on_with_the_photos_that_it_began_with(
    project: SimpleNamespace, change: Callable[[Path], None]
) -> None:
    change(project.scene)
    with pytest.raises(SystemExit, match=r"The checkpoint .*\.ckpt doesn't fit .* as it is now"):
        resume(project, "coarse-fewshot")


@pytest.mark.parametrize("flags", [["--num-views", "2"], ["--view-ids", "1", "5", "10"]])
def test_training_goes_on_with_the_views_that_it_began_with(project: SimpleNamespace, flags: List[str]) -> None:
    with pytest.raises(SystemExit, match=r"trained on views \[1, 5, 11\]"):
        resume(project, "coarse-fewshot", *flags)
    checkpoint = newest_checkpoint(project.coarse / "nerfstudio_models")
    with pytest.raises(SystemExit, match="doesn't fit"):
        ns_train(
            *("coarse-fewshot", project.scene, project.root / "more", "--load-checkpoint", str(checkpoint)),
            *("--max-num-iterations", "4", *TINY, *flags),
        )


def test_a_held_out_photo_may_change_where_training_goes_on(project: SimpleNamespace) -> None:
    change_held_out_photo(project.scene)
    resume(project, "coarse-fewshot")
    main(["evaluate", str(only_run(project.root / "more", "coarse-fewshot"))])


def test_stylising_goes_on_with_the_painting_that_it_began_with(project: SimpleNamespace) -> None:
    with Image.open(project.painting) as painting:
        painting.rotate(180).save(project.painting)
    with pytest.raises(SystemExit, match=r"The style image painting\.png isn't the one that the checkpoint"):
        resume(project, "hier-style")


def test_nothing_is_measured_against_a_painting_that_has_changed(
    project: SimpleNamespace, capsys: pytest.CaptureFixture
) -> None:
    with Image.open(project.painting) as painting:
        painting.rotate(180).save(project.painting)
    main(["evaluate", str(project.style)])
    assert "is another picture by now, so nothing is measured against it" in " ".join(capsys.readouterr().out.split())
    assert "style_loss" not in json.loads((project.style / "evaluation.json").read_text())["results"]


def test_a_coarse_run_of_photos_that_have_changed_isnt_stylised(project: SimpleNamespace) -> None:
    from sparsestyle_ns.runs.coarse_run import find_coarse_run

    change_photo(project.scene)
    flags = ["--style-image", str(project.painting), "--max-num-iterations", "1", *TINY_STYLE]
    with pytest.raises(SystemExit, match=r"doesn't fit .* image005\.png is another picture by now"):
        ns_train("hier-style", project.scene, project.root, *flags, "--coarse-run", str(project.coarse))
    manager = FewShotDataManagerConfig(data=project.scene, dataparser=LLFFDataParserConfig())
    config = load_config(project.coarse)
    scene = manager.setup(device="cpu", test_mode="inference").record(config.pipeline.decided)
    assert find_coarse_run(project.root / "outputs", ["coarse-fewshot"], scene) is None


def load_config(run: Path):
    return yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)


def test_a_report_of_other_weights_isnt_shown_as_the_runs_own(project: SimpleNamespace) -> None:
    main(["evaluate", str(project.coarse)])
    assert saved_report(project.coarse, 2) is not None
    checkpoint = newest_checkpoint(project.coarse / "nerfstudio_models")
    state = torch.load(checkpoint, weights_only=True)
    state["pipeline"]["_model.field.density_head.bias"].fill_(9.0)
    torch.save(state, checkpoint)
    assert saved_report(project.coarse, 2) is None


def test_a_study_trains_anew_where_photos_have_changed(project: SimpleNamespace) -> None:
    def digest() -> str:
        return Study(project.scene, LLFFDataParserConfig(), coarse_iterations=1, style_iterations=1).photo_digest

    before = digest()
    assert before == digest() != ""
    change_photo(project.scene)
    assert digest() != before
    assert Study(project.scene / "gone", LLFFDataParserConfig()).photo_digest == ""


NAMES = st.text(st.sampled_from("ab ._-é"), min_size=1, max_size=4).filter(lambda name: name.strip(".") == name)
PLACES = st.lists(NAMES, min_size=0, max_size=3)


@given(run=PLACES, data=PLACES, moved=PLACES, kind=st.sampled_from(["together", "run", "data"]))
def test_a_scene_is_found_where_it_is_or_refused_never_another(
    tmp_path_factory: pytest.TempPathFactory, run: List[str], data: List[str], moved: List[str], kind: str
) -> None:
    """Folders of a run and of its scene that move, together or alone, to any places."""
    root = tmp_path_factory.mktemp("places").resolve()
    before = root.joinpath("before")
    folder, scene = before.joinpath("outputs", *run, "run"), before.joinpath("scenes", *data, "scene")
    for each in (folder, scene):
        each.mkdir(parents=True)
    (scene / "mark").touch()
    cameras = np.zeros((1, 3, 4)).tolist()
    SceneRecord(str(scene), [0], ["a.png"], [[0.0] * 3, [1.0] * 3], cameras, None, {}).save(folder)
    target = root.joinpath("after", *moved, "here")
    target.parent.mkdir(parents=True)
    if kind == "together":
        before.rename(target)
        folder, scene = target / folder.relative_to(before), target / scene.relative_to(before)
    elif kind == "run":
        folder = folder.rename(target)
    else:
        scene.rename(target)
    loaded = SceneRecord.load(folder)
    if kind == "data":
        with pytest.raises(InputError, match="isn't at"):
            loaded.find_data(folder)
    else:
        assert os.path.samefile(loaded.find_data(folder), scene)
        assert (loaded.find_data(folder) / "mark").exists()


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photos from all around with their transforms.json."""
    folder = tmp_path_factory.mktemp("ring") / "scene"
    write_transforms(folder, write_ring(folder))
    return folder


def reorder(content: Dict, place: int, amount: float) -> None:
    """nerfstudio sorts frames by the names of their photos."""
    content["frames"] = content["frames"][place:] + content["frames"][:place]


def drop(content: Dict, place: int, amount: float) -> None:
    del content["frames"][place]


def move(content: Dict, place: int, amount: float) -> None:
    content["frames"][place]["transform_matrix"][0][3] += amount


def exchange(content: Dict, place: int, amount: float) -> None:
    one, other = content["frames"][place], content["frames"][(place + 1) % 6]
    one["file_path"], other["file_path"] = other["file_path"], one["file_path"]


def hold_out(content: Dict, place: int, amount: float) -> None:
    names = [frame["file_path"] for frame in content["frames"]]
    content["train_filenames"] = names[:place] + names[place + 1 :]
    content["val_filenames"] = content["test_filenames"] = [names[place]]


def leave(content: Dict, place: int, amount: float) -> None:
    """No change."""


@given(
    change=st.sampled_from([leave, reorder, drop, move, exchange, hold_out]),
    place=st.integers(0, 5),
    amount=st.floats(0.05, 1.0),
)
def test_a_transforms_file_that_says_something_else_is_refused(
    ring: Path, tmp_path_factory: pytest.TempPathFactory, change: Callable, place: int, amount: float
) -> None:
    scene = shutil.copytree(ring, tmp_path_factory.mktemp("changed") / "scene")
    config = FewShotDataManagerConfig(data=scene, dataparser=NerfstudioDataParserConfig(), max_image_side=None)
    manager = config.setup(device="cpu", test_mode="test")
    outputs = manager.train_dataparser_outputs, None, manager.measured_views()
    config.expected = ExpectedScene(record_scene(scene, *outputs), "The run", "see to it")
    content = json.loads((scene / "transforms.json").read_text())
    change(content, place, amount)
    (scene / "transforms.json").write_text(json.dumps(content))
    if change in (leave, reorder):
        config.setup(device="cpu", test_mode="test")
    else:
        with pytest.raises(InputError, match=r"The run doesn't fit .* as it is now \(.*\); see to it"):
            config.setup(device="cpu", test_mode="test")
