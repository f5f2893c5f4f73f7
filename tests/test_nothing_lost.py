"""What a command saved stays: another one takes a new name, or is told that what is there may be lost."""

import contextlib
import errno
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Dict, Iterator, List

import pytest
from conftest import TINY, TINY_STYLE, ns_train, run_entrypoint
from interrupted import finish
from PIL import Image
from test_commands import press_ctrl_c_at
from test_other_data import files_below, ns_command, refused

from sparsestyle_ns.cli import main
from sparsestyle_ns.engine.trainer import CoarseFewShotTrainer
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import hold_folder, read_config
from sparsestyle_ns.studies.study_options import CompareOptions
from sparsestyle_ns.studies.tradeoff_report import report_folder
from sparsestyle_ns.utils import files
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import free_path

pytestmark = pytest.mark.usefixtures("quick_reports")


@pytest.fixture
def run(runs: SimpleNamespace, tmp_path: Path) -> Path:
    """A coarse run of three iterations, named `first`, below `tmp_path`."""
    import yaml

    folder = shutil.copytree(runs.coarse, tmp_path / "llff" / "coarse-fewshot" / "first")
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir, config.timestamp = tmp_path, "first"
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder


def steps(folder: Path) -> List[int]:
    """Iterations of the checkpoints in a run's folder."""
    return sorted(map(checkpoint_step, (folder / "nerfstudio_models").glob("*.ckpt")))


def train_again(run: Path, scene: Path, *flags: str) -> None:
    ns_train("coarse-fewshot", scene, run.parents[2], "--timestamp", "first", *TINY, *flags)


def load_config(run: Path, method: str = "coarse-fewshot", *flags: str) -> None:
    """`ns-train coarse-fewshot --load-config` of a run, without a viewer."""
    from nerfstudio.scripts import train

    run_entrypoint(train.entrypoint, [method, "--load-config", str(run / "config.yml"), *flags])


@pytest.mark.parametrize("iterations", ["2", "3", "5"])
def test_a_run_never_takes_the_folder_of_another(run: Path, llff_scene: Path, iterations: str) -> None:
    before = files_below(run)
    with pytest.raises(SystemExit, match=r"There is a run in .*first already; name a new one with --timestamp, or"):
        train_again(run, llff_scene, "--max-num-iterations", iterations)
    assert files_below(run) == before


def test_what_is_said_of_a_taken_folder_can_be_done(run: Path, llff_scene: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        train_again(run, llff_scene, "--max-num-iterations", "5")
    (resume,) = re.findall("by (--load-dir .*)[.]$", str(ended.value.code))
    train_again(run, llff_scene, "--max-num-iterations", "5", *shlex.split(resume))
    assert steps(run) == [2, 4]  # it goes on in the same folder, and what was there stays
    ns_train(
        *("coarse-fewshot", llff_scene, run.parents[2], "--timestamp", "second", "--max-num-iterations", "1"), *TINY
    )
    assert steps(run.with_name("second")) == [0]


@pytest.mark.parametrize("flags", [["--num-views", "2"], ["--max-num-iterations", "3"], ["--previews", "2"]])
def test_a_run_that_isnt_gone_on_with_stays_as_it_is(run: Path, llff_scene: Path, flags: List[str]) -> None:
    before = files_below(run)
    with pytest.raises(SystemExit, match="Error: "):
        train_again(run, llff_scene, "--load-dir", str(run / "nerfstudio_models"), *flags)
    assert files_below(run) == before


def test_a_run_isnt_gone_on_with_by_the_other_method(
    run: Path, runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    more = ["--max-num-iterations", "9"]
    style = ["--style-image", str(painting), "--load-dir", str(runs.coarse / "nerfstudio_models"), *TINY_STYLE]
    with pytest.raises(SystemExit, match=r"is of coarse-fewshot; name its run with --coarse-run instead[.]$"):
        ns_train("hier-style", llff_scene, tmp_path / "new", *style, *more)
    coarse = ["--load-dir", str(runs.style / "nerfstudio_models"), *TINY]
    with pytest.raises(SystemExit, match=r"is of hier-style; go on with that instead[.]$"):
        ns_train("coarse-fewshot", llff_scene, tmp_path / "new", *coarse, *more)


def test_a_run_isnt_gone_on_with_from_before_its_newest_checkpoint_in_its_own_folder(
    run: Path, llff_scene: Path
) -> None:
    """What would be the newest checkpoint then would be of the former run."""
    models = run / "nerfstudio_models"
    shutil.copy(models / "step-000000002.ckpt", models / "step-000000009.ckpt")
    resume = ["--load-dir", str(models), "--load-step", "2", "--max-num-iterations", "5"]
    with pytest.raises(SystemExit, match="There is a run in"):
        train_again(run, llff_scene, *resume)
    ns_train("coarse-fewshot", llff_scene, run.parents[2], *resume, *TINY)
    (new,) = (folder for folder in run.parent.iterdir() if folder != run)
    assert steps(run) == [2, 9] and steps(new) == [4]
    ns_command("ns-eval", "--load-config", new / "config.yml", "--output-path", run.parents[2] / "a.json")


def test_the_config_of_a_finished_run_begins_another_one(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    before = files_below(run)
    with monkeypatch.context() as patch, contextlib.suppress(SystemExit):
        press_ctrl_c_at(patch, step=1)
        load_config(run)
    assert files_below(run) == before
    (new,) = (folder for folder in run.parent.iterdir() if folder != run)
    assert steps(new) == [1]
    printed = capsys.readouterr().out
    assert f"The run {run} is finished and stays as it is; this is a new one, {new}." in " ".join(printed.split())
    command = shlex.split(printed.splitlines()[-1].split(" – next: ")[1])
    assert command == ["ns-train", "coarse-fewshot", "--load-config", str(new / "config.yml")]
    load_config(new)  # which that command does
    assert steps(new) == [1, 2]
    assert files_below(run) == before


def test_what_is_typed_beside_a_config_is_named_and_another_method_refused(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    before = files_below(run.parents[1])
    advice = (
        f"of a run of coarse-fewshot, and hier-style was asked for; type ns-train coarse-fewshot --load-config {run}"
    )
    with pytest.raises(SystemExit, match=re.escape(advice)):
        load_config(run, "hier-style")
    assert files_below(run.parents[1]) == before
    with monkeypatch.context() as patch, contextlib.suppress(SystemExit):
        press_ctrl_c_at(patch, step=1)
        load_config(run, "coarse-fewshot", "--max-num-iterations=1", "--previews", "1.0")
    printed = " ".join(capsys.readouterr().out.split())
    assert "Without effect beside --load-config, whose file says all: --max-num-iterations, --previews." in printed


def test_runs_that_begin_in_one_second_have_folders_of_their_own(tmp_path: Path) -> None:
    from sparsestyle_ns.method_configs import method_config

    names = []
    for _ in range(2):
        config = method_config("coarse-fewshot")
        config.output_dir, config.data, config.timestamp = tmp_path, Path("fern"), "{timestamp}"
        config.set_timestamp()
        config.get_base_dir().mkdir(parents=True)
        names.append(config.timestamp)
    assert len(set(names)) == 2


HOLD = """
import sys, pathlib
from sparsestyle_ns.runs.run_folder import hold_folder, read_config
hold_folder(pathlib.Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_two_commands_never_train_in_one_folder_at_once(llff_scene: Path, tmp_path: Path) -> None:
    """The first has no checkpoint yet, by which the second would see that there is a run."""
    folder = tmp_path / "outputs" / llff_scene.name / "coarse-fewshot" / "first"
    command = [sys.executable, "-c", HOLD, str(folder)]
    flags = ["--timestamp", "first", "--max-num-iterations", "1", *TINY]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(SystemExit, match=r"Another ns-train is at work in .*first right now; wait .*--timestamp"):
            ns_train("coarse-fewshot", llff_scene, tmp_path / "outputs", *flags)
        assert folder.is_dir() and not list(folder.iterdir())
        other.communicate()
    ns_train("coarse-fewshot", llff_scene, tmp_path / "outputs", *flags)
    assert steps(folder) == [0]


def test_a_finished_run_is_free_for_others_while_its_process_goes_on(
    llff_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As hier-style goes on after the coarse run that it has trained, and ns-train while its viewer is open."""
    from nerfstudio.engine.trainer import Trainer
    from nerfstudio.utils import decorators

    def can_be_held(folder: Path) -> bool:
        command = [sys.executable, "-c", HOLD, str(folder)]
        return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True).stdout == "held\n"

    seen = []

    def complete(trainer: Trainer) -> None:
        assert can_be_held(trainer.base_dir)
        seen.append(trainer.base_dir)

    monkeypatch.setattr(Trainer, "_train_complete_viewer", complete)
    monkeypatch.setattr(decorators, "check_viewer_enabled", lambda function: function)
    flags = ["--timestamp", "first", "--max-num-iterations", "1", *TINY]
    ns_train("coarse-fewshot", llff_scene, tmp_path, *flags)
    folder = tmp_path / llff_scene.name / "coarse-fewshot" / "first"
    assert can_be_held(folder)
    config = SimpleNamespace(is_viewer_enabled=lambda: True, is_viewer_legacy_enabled=lambda: False)
    hold_folder(folder)
    trainer = SimpleNamespace(base_dir=folder, config=config, finish=lambda: None, _interrupted=False)
    assert not can_be_held(folder)
    trainer_class = type("T", (CoarseFewShotTrainer,), {"__init__": lambda self: vars(self).update(vars(trainer))})
    trainer_class()._train_complete_viewer()
    assert seen == [folder]


def test_a_run_is_read_while_another_process_trains_in_its_folder_and_drops_checkpoints(run: Path) -> None:
    config, (checkpoint,) = read_config(run), (run / "nerfstudio_models").glob("*")
    content = checkpoint.read_bytes()
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(run)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        config.open_in(run)
        other.communicate()
    checkpoint.unlink()
    assert (config.get_checkpoint_dir() / checkpoint.name).read_bytes() == content
    assert config.get_base_dir() == run


@contextlib.contextmanager
def full_disk(owner: object, name: str) -> Iterator[None]:
    """A function that writes fails as it does on a disk that is full."""

    def fail(*arguments: object, **settings: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, fail)
        yield


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("export {style} --format ply --output-path {made}/a.ply", "The points"),
        ("export {style} --format mesh --output-path {made}/a.ply", "The mesh"),
        ("gallery {style} --frames 0 --num-views 1 --output-path {made}/a.html", "The page"),
        ("evaluate {coarse} --output-path {made}/a.json", "The report"),
        ("prepare {scene} --output {made}/a", "The scene"),
    ],
)
def test_what_the_disk_has_no_room_for_leaves_nothing(
    patterned_run: Path, runs: SimpleNamespace, llff_scene: Path, tmp_path: Path, command: str, sentence: str
) -> None:
    if "mesh" in command:
        pytest.importorskip("open3d", exc_type=ImportError)
    (tmp_path / "made").mkdir()
    places = {"style": patterned_run, "coarse": runs.coarse, "scene": llff_scene, "made": tmp_path / "made"}
    writer = (Image.Image, "save") if "prepare" in command else (files.os, "fsync")
    with full_disk(*writer):
        message = refused(command.format(**places).split())
    assert message.startswith(f"Error: {sentence} can't be written to {tmp_path / 'made' / 'a'}")
    assert "(No space left on device); name another place with --output" in message
    assert not list((tmp_path / "made").iterdir())


@pytest.mark.parametrize(
    "what", ["pointcloud --normal-method open3d --num-points 2000", "tsdf --resolution 32 --texture-method tsdf"]
)
def test_what_nerfstudio_has_no_room_for_leaves_nothing(patterned_run: Path, tmp_path: Path, what: str) -> None:
    """Open3D says on a line for each number that it can't be written, and that all is well."""
    pytest.importorskip("open3d", exc_type=ImportError)
    (tmp_path / "made").mkdir()
    words = ["ns-export", *what.split(), "--output-dir", tmp_path / "made" / "a"]
    ending = finish([*words, "--load-config", patterned_run / "config.yml"], tmp_path / "log", room=20_000)
    assert ending.status == 1 and "Traceback" not in ending.printed, ending.printed[-3000:]
    assert not list((tmp_path / "made").iterdir())


def test_a_run_that_the_disk_has_no_room_for_says_so_and_keeps_what_it_has(run: Path, llff_scene: Path) -> None:
    import torch

    new = ["--timestamp", "second", "--max-num-iterations", "1", *TINY]
    with full_disk(torch, "save"), pytest.raises(SystemExit, match="nothing was saved before, so make room on the"):
        ns_train("coarse-fewshot", llff_scene, run.parents[2], *new)
    resume = ["--load-dir", str(run / "nerfstudio_models"), "--max-num-iterations", "5"]
    with full_disk(torch, "save"), pytest.raises(SystemExit, match=r"iteration 3 is saved, so make room .* --load-dir"):
        train_again(run, llff_scene, *resume)
    assert steps(run) == [2]
    train_again(run, llff_scene, *resume)
    assert steps(run) == [2, 4]


@pytest.mark.parametrize("kind", [errno.ENOSPC, errno.EACCES])
def test_a_disk_that_fails_anywhere_in_a_command_is_said(
    runs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, kind: int
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(kind, "so it is", "a/file")

    monkeypatch.setattr("sparsestyle_ns.engine.loading.load_run", fail)
    assert refused(["evaluate", str(runs.coarse), "--output-path", "a.json"]) == (
        "Error: a/file can't be read or written (so it is); see to the disk and its rights, and try again."
    )


def test_a_report_of_something_else_is_kept_under_another_name(run: Path, capsys: pytest.CaptureFixture) -> None:
    (run / "evaluation.json").write_text("mine")
    main(["evaluate", str(run)])
    assert (run / "evaluation-2.json").read_text() == "mine"
    assert f"kept as {run / 'evaluation-2.json'}" in " ".join(capsys.readouterr().out.split())
    report = (run / "evaluation.json").read_text()
    main(["evaluate", str(run)])  # says the same again, so nothing is lost
    assert (run / "evaluation.json").read_text() == report
    assert not (run / "evaluation-3.json").exists()


def outputs_of(runs: SimpleNamespace, target: Path) -> Dict[str, List[str]]:
    """Commands that write a file, by what they are."""
    few = ["--num-views", "1", "--frames", "0"]
    return {
        "report": ["evaluate", str(runs.coarse), "--output-path", str(target)],
        "gallery": ["gallery", str(runs.style), "--output-path", str(target), *few],
        "points": ["export", str(runs.style), "--format", "ply", "--output-path", str(target)],
        "page": ["export", str(runs.style), "--output-path", str(target)],
    }


@pytest.mark.parametrize("what", ["report", "gallery", "points", "page"])
def test_a_file_that_is_there_is_written_over_only_where_that_is_asked_for(
    runs: SimpleNamespace, tmp_path: Path, what: str
) -> None:
    target = tmp_path / "made.html"
    target.write_text("mine")
    arguments = outputs_of(runs, target)[what]
    message = refused(arguments)
    other = tmp_path / "made-2.html"
    assert message.endswith(f"is there already; name another file, such as {other}, or write over it with --force.")
    assert target.read_text() == "mine"
    if what != "page":  # which takes longer, and is written by the same function
        main([str(other) if part == str(target) else part for part in arguments])
        assert other.exists() and target.read_text() == "mine"
        main([*arguments, "--force"])
        assert target.read_text(errors="replace") != "mine"


def test_figures_of_ns_eval_never_take_the_place_of_others(
    runs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = "--load-config", runs.coarse / "config.yml"
    Path("output.json").write_text("mine")
    ns_command("ns-eval", *config)  # without a name it takes a new one
    assert Path("output.json").read_text() == "mine" and Path("output-2.json").is_file()
    Path("pictures").mkdir()
    Path("pictures/mine.png").touch()
    before = files_below(tmp_path)
    for flags, sentence in (
        (["--output-path", "output-2.json"], "take output-2-2.json or another place"),
        (["--output-path", "report.txt"], "ns-eval writes JSON, .* take report.txt.json"),
        (["--output-path", "pictures"], "ns-eval writes JSON, .* take pictures.json"),
        (["--output-path", "output.json/a.json"], "name another place with --output-path"),
        (["--output-path", "a.json", "--render-output-path", "pictures"], "--render-output-path .* take pictures-2"),
    ):
        with pytest.raises(SystemExit, match=sentence):
            ns_command("ns-eval", *config, *flags)
    assert files_below(tmp_path) == before


def test_a_gallery_without_a_name_gets_one_of_its_own(
    runs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("gallery.html", "scene.html"):
        Path(name).write_text("mine")
    main(["gallery", str(runs.style), "--num-views", "1", "--frames", "0"])
    assert Path("gallery.html").read_text() == "mine" and Path("gallery-2.html").is_file()
    assert capsys.readouterr().out.splitlines()[-1].endswith("--output-path scene-2.html")


def test_a_tradeoff_report_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert report_folder(None, force=False) == Path("tradeoff")
    (tmp_path / "tradeoff").mkdir()
    (tmp_path / "tradeoff" / "tradeoff.csv").touch()
    assert report_folder(None, force=False) == Path("tradeoff-2")
    with pytest.raises(InputError, match=r"tradeoff already .*such as tradeoff-2, or write over it with --force"):
        report_folder(Path("tradeoff"), force=False)
    assert report_folder(Path("tradeoff"), force=True) == Path("tradeoff")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    assert report_folder(Path("mine"), force=False) == Path("mine")  # a folder may have other files


def test_a_studys_page_that_said_something_else_is_kept(tmp_path: Path) -> None:
    from sparsestyle_ns.studies.paper_studies import _write_page

    options = CompareOptions(tmp_path, (Path("a.png"),), tmp_path / "compare.html")
    options.output_path.write_text("mine")
    runs = SimpleNamespace(study=SimpleNamespace(name="fern"))
    for _ in range(2):  # the second page is the first
        assert _write_page("Comparison", options, runs, []) == options.output_path.resolve()
    assert {path.name for path in tmp_path.iterdir()} == {"compare.html", "compare-2.html"}
    assert (tmp_path / "compare-2.html").read_text() == "mine"


def test_free_names_keep_suffixes_and_count_on(tmp_path: Path) -> None:
    assert free_path(tmp_path / "a.tar.gz") == tmp_path / "a.tar.gz"
    for name in ("a.html", "a-2.html", "folder"):
        (tmp_path / name).touch()
    assert free_path(tmp_path / "a.html") == tmp_path / "a-3.html"
    assert free_path(tmp_path / "folder") == tmp_path / "folder-2"


def test_the_folder_that_one_is_in_has_free_names_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    assert free_path(Path(".")) == tmp_path / "here" / "below-2"
    assert free_path(Path("..")) == tmp_path / "here-2"


def test_a_painting_is_painted_over_only_where_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    import make_style_image

    target = tmp_path / "mine.png"
    target.write_bytes(b"mine")
    assert make_style_image.main([str(target), "--size", "64"]) != 0
    assert "add --force to replace it, or choose another OUTPUT" in capsys.readouterr().err
    assert target.read_bytes() == b"mine"
    assert make_style_image.main([str(target), "--size", "64", "--force"]) == 0
    assert target.read_bytes() != b"mine"


def test_inputs_are_only_read(runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path) -> None:
    """Photos, painting and the run itself, by all commands that look at a run without being asked to write there."""
    inputs = llff_scene, painting.parent, runs.coarse, runs.style
    before = list(map(files_below, inputs))
    main(["evaluate", str(runs.style), "--output-path", str(tmp_path / "report.json")])
    main(["gallery", str(runs.style), "--output-path", str(tmp_path / "page.html"), "--frames", "2"])
    main(["export", str(runs.style), "--format", "ply", "--output-path", str(tmp_path / "scene.ply")])
    main(["effects", "--data", str(llff_scene), "--coarse-run", str(runs.coarse)])
    config = ["--load-config", runs.style / "config.yml"]
    ns_command("ns-eval", *config, "--output-path", tmp_path / "theirs.json")
    ns_command("ns-render", "dataset", *config, "--output-path", tmp_path / "pictures")
    flags = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), "--max-num-iterations", "1"]
    ns_train("hier-style", llff_scene, tmp_path / "outputs", *flags, *TINY_STYLE)
    assert list(map(files_below, inputs)) == before


def test_what_was_measured_of_an_earlier_iteration_stays(tmp_path: Path) -> None:
    from sparsestyle_ns.studies.run_figures import FIGURES_FILE, _free_for

    folder = tmp_path / "measured"
    assert _free_for(folder, 9) == folder
    folder.mkdir()
    (folder / FIGURES_FILE).write_text(json.dumps({"step": 9, "figures": {}}))
    assert _free_for(folder, 9) == folder
    assert _free_for(folder, 19) == tmp_path / "measured-000000019"


def test_only_checkpoints_of_its_own_are_dropped(run: Path, llff_scene: Path) -> None:
    """Those of every save are kept by nerfstudio's own flag, here for three iterations of each."""
    every = ["--steps-per-save", "1", "--load-dir", str(run / "nerfstudio_models")]
    train_again(run, llff_scene, "--max-num-iterations", "5", "--save-only-latest-checkpoint", "False", *every)
    assert steps(run) == [2, 3, 4]
    train_again(run, llff_scene, "--max-num-iterations", "8", *every)
    assert steps(run) == [2, 3, 4, 7]
    assert newest_checkpoint(run / "nerfstudio_models").name == "step-000000007.ckpt"
