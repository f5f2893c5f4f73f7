"""The last line of every command says what was made and what to type next, and what it says can be typed."""

import shlex
from pathlib import Path

import pytest
import tyro
from conftest import TINY, TINY_STYLE, ns_train, only_run, run_entrypoint
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts import train
from PIL import Image

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.engine.hints import after_evaluation, after_export, finish, resume_command
from sparsestyle_ns.prepare.measure_effects import next_command
from sparsestyle_ns.prepare.prepare_options import EffectsOptions


def parsed(command: list):
    """The config that ns-train makes of a command."""
    assert command[0] == "ns-train"
    return tyro.cli(AnnotatedBaseConfigUnion, args=[str(part) for part in command[1:]])


def test_the_last_line_can_be_typed_as_it_stands(capsys: pytest.CaptureFixture) -> None:
    finish(Path("out/my scene"), ["ns-viewer", "--load-config", Path("out/my scene/config.yml")])
    assert capsys.readouterr().out == "Made out/my scene – next: ns-viewer --load-config 'out/my scene/config.yml'\n"


def test_a_command_that_only_prints_says_that_nothing_was_saved(capsys: pytest.CaptureFixture) -> None:
    finish(None, ["ns-train"])
    assert capsys.readouterr().out == "Nothing was saved – next: ns-train\n"


def test_resuming_types_the_same_command_with_the_checkpoints() -> None:
    typed = [
        "hier-style",
        "--load-dir",
        "old",
        "--style-image",
        "a.jpg",
        "--load-step=3",
        "--data",
        "fern",
        "llff-data",
    ]
    given = resume_command("hier-style", Path("run/nerfstudio_models"), typed)
    assert given == [
        *("ns-train", "hier-style", "--load-dir", "run/nerfstudio_models"),
        *("--style-image", "a.jpg", "--data", "fern", "llff-data"),
    ]


def test_resuming_a_run_that_something_else_began_names_its_checkpoints() -> None:
    given = resume_command("coarse-fewshot", Path("models"), ["-q", "tests"])
    assert given == ["ns-train", "coarse-fewshot", "--load-dir", "models"]


def test_after_the_effects_comes_training_on_the_same_views() -> None:
    options = EffectsOptions(Path("fern"), view_ids=(1, 10, 19))
    config = parsed(next_command(LLFFDataParserConfig(), options))
    assert config.method_name == "coarse-fewshot"
    assert config.pipeline.datamanager.view_ids == (1, 10, 19)
    assert config.data == Path("fern")
    options = EffectsOptions(Path("fern"), num_views=5, coarse_run=Path("run"), style_image=Path("hat.jpg"))
    config = parsed(next_command(LLFFDataParserConfig(), options))
    assert config.method_name == "hier-style"
    assert config.pipeline.coarse_run == Path("run")
    assert config.pipeline.style_image == Path("hat.jpg")
    assert config.pipeline.datamanager.num_views == 5


def test_a_page_is_looked_at_and_points_become_a_page(tmp_path: Path) -> None:
    command = after_export(Path("run"), tmp_path / "scene.html", "html")
    assert command == ["python", "-m", "webbrowser", (tmp_path / "scene.html").as_uri()]
    command = after_export(Path("run"), Path("scene.ply"), "ply")
    assert shlex.join(map(str, command)) == "sparsestyle export run --format html --output-path scene.html"


def last_line(capsys: pytest.CaptureFixture) -> str:
    return capsys.readouterr().out.splitlines()[-1]


def typed_after(line: str) -> list:
    """The command that a last line says to type next, in parts."""
    return shlex.split(line.split(" – next: ")[1])


def test_training_writes_previews_and_ends_with_a_command_that_works(
    llff_scene: Path, painting: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    flags = ["--view-ids", "1", "5", "11", "--max-num-iterations", "4", "--previews", "0.25", "1.0"]
    ns_train("coarse-fewshot", llff_scene, tmp_path, *flags, "--pipeline.effects.view-color", "on", *TINY)
    run = only_run(tmp_path, "coarse-fewshot")
    line = last_line(capsys)
    assert line.startswith(f"Made {run} – next: ns-train hier-style --style-image PAINTING.jpg ")
    assert sorted(path.name for path in (run / "previews").iterdir()) == ["after-000001.png", "after-000004.png"]
    with Image.open(run / "previews" / "after-000004.png") as picture:
        assert picture.size == (2 * 32, 24)
    command = [str(painting) if part == "PAINTING.jpg" else part for part in typed_after(line)]
    config = parsed(command)
    assert config.pipeline.datamanager.view_ids == (1, 5, 11)
    assert config.data == llff_scene
    assert config.output_dir == tmp_path
    assert config.pipeline.effects.view_color == "on"
    assert config.pipeline.coarse_run == run
    assert after_evaluation(run, stylised=False) == typed_after(line)
    assert after_evaluation(run, stylised=True) == ["sparsestyle", "gallery", str(run)]

    # Typed with the settings of a tiny field beside, it runs, and says what comes after it.
    tiny = [*TINY_STYLE[: TINY_STYLE.index("--pipeline.effects.empty-space")], "--max-num-iterations", "2"]
    run_entrypoint(train.entrypoint, [command[1], *tiny, "--viewer.quit-on-train-completion", "True", *command[2:]])
    styled = only_run(tmp_path, "hier-style")
    assert last_line(capsys) == f"Made {styled} – next: sparsestyle gallery {styled}"
    with Image.open(styled / "previews" / "after-000002.png") as picture:
        assert picture.size == (3 * 32, 24)
    assert tensorboard_images(styled) == {"Preview": [1, 2]}


def tensorboard_images(run: Path) -> dict:
    """The steps of each picture that a run has in tensorboard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run), size_guidance={"images": 0})
    events.Reload()
    return {tag: [event.step for event in events.Images(tag)] for tag in events.Tags()["images"]}
