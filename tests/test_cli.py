"""`sparsestyle`: help is there at once, and what can't be used is said in one sentence."""

import os
import subprocess
import sys

import pytest

from sparsestyle_ns.cli import SUBCOMMANDS, main, with_dashes
from sparsestyle_ns.gallery import make_gallery
from sparsestyle_ns.gallery.film import read_film


def run_main(arguments, capsys):
    """(exit status or message, what was printed)."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return ended.value.code, capsys.readouterr().out


def write_configs(folder):
    """A stylised run and a coarse one, as far as their folders tell."""
    for name, method in (("run", "hier-style"), ("coarse", "coarse-fewshot")):
        (folder / name).mkdir()
        (folder / name / "config.yml").write_text(f"method_name: {method}\n")


def test_help_lists_every_subcommand(capsys):
    status, printed = run_main(["--help"], capsys)
    assert status == 0
    assert all(name in printed for name in SUBCOMMANDS)
    assert "gallery" in SUBCOMMANDS


def test_help_loads_neither_torch_nor_nerfstudio():
    code = (
        "import sys, sparsestyle_ns.cli as cli\n"
        "try:\n    cli.main(['--help'])\n"
        "except SystemExit:\n    print([name for name in ('torch', 'nerfstudio', 'cv2') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["{tmp}/gone"], "Error: There is no run at {tmp}/gone;"),
        (["{tmp}/coarse"], "Error: {tmp}/coarse is a run of coarse-fewshot; name a run of hier-style"),
        ([], "Error: There is no run to show;"),
        (["{tmp}/run", "--video", "{tmp}/1.mp4", "{tmp}/2.mp4"], "Error: There are 2 videos for 1 runs;"),
        (["{tmp}/run", "--video", "{tmp}/gone.mp4"], "Error: The video {tmp}/gone.mp4 can't be read"),
        (["{tmp}/run", "--frames", "-1"], "Error: --frames is -1;"),
        (["{tmp}/run", "--output-path", "{tmp}"], "Error: --output-path {tmp} is a folder;"),
        (["{tmp}/run", "--output-path", "{tmp}/run/config.yml/page.html"], "Error: The page can't be written to"),
    ],
)
def test_what_can_not_be_used_is_said_in_one_sentence(tmp_path, capsys, arguments, sentence):
    write_configs(tmp_path)
    given = [argument.format(tmp=tmp_path) for argument in arguments]
    if "--output-path" not in given:
        given += ["--output-path", str(tmp_path / "page.html")]
    message, _ = run_main(["gallery", *given], capsys)
    assert message.startswith(sentence.format(tmp=tmp_path))
    assert "\n" not in message
    assert not (tmp_path / "page.html").exists()


def test_an_error_goes_to_stderr_with_exit_status_1(tmp_path):
    arguments = ["gallery", str(tmp_path / "gone"), "--output-path", str(tmp_path / "page.html")]
    done = subprocess.run(
        [sys.executable, "-c", "from sparsestyle_ns.cli import main; main()", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("Error: There is no run at")
    assert len(done.stderr.splitlines()) == 1


def test_gallery_gives_each_run_its_video_and_says_last_where_the_page_is(tmp_path, capsys, monkeypatch):
    film = tmp_path / "film.mp4"
    film.write_bytes(b"\0\0\0\x18ftyp")
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yml").write_text("method_name: hier-style\n")
    pages = []
    monkeypatch.setattr(make_gallery, "collect_run", lambda *given: given)
    monkeypatch.setattr(make_gallery, "gallery_page", lambda *given: pages.append(given) or "<html>")
    target = tmp_path / "page.html"
    given = [str(tmp_path / "first"), str(tmp_path / "second" / "config.yml"), "--output-path", str(target)]
    main(["gallery", *given, "--video", str(film), "--title", "Two scenes", "--num-views", "2", "--frames", "0"])
    runs = [(tmp_path / "first", read_film(film), 2, 0, False)]
    runs.append((tmp_path / "second" / "config.yml", None, 2, 0, False))
    assert pages == [(runs, "Two scenes")]
    assert target.read_text() == "<html>"
    export = f"sparsestyle export {tmp_path / 'first'} --format html --output-path scene.html"
    assert capsys.readouterr().out.splitlines()[-1] == f"Made {target} – next: {export}"


@pytest.mark.parametrize(
    ("run", "arguments", "sentence"),
    [
        ("run", ["--style-image", "{tmp}/gone.jpg"], "Error: The style image {tmp}/gone.jpg does not exist"),
        ("coarse", ["--style-image", "{tmp}/a.jpg"], "Error: {tmp}/coarse is a run of coarse-fewshot;"),
        ("coarse", ["--baked"], "Error: {tmp}/coarse is a run of coarse-fewshot;"),
    ],
)
def test_evaluate_leaves_out_nothing_that_was_asked_for(tmp_path, capsys, run, arguments, sentence):
    write_configs(tmp_path)
    given = [argument.format(tmp=tmp_path) for argument in arguments]
    message, _ = run_main(["evaluate", str(tmp_path / run), *given, "--output-path", str(tmp_path / "a.json")], capsys)
    assert message.startswith(sentence.format(tmp=tmp_path))


def test_ctrl_c_ends_a_command_without_a_traceback(tmp_path, capsys, monkeypatch):
    def press(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr("sparsestyle_ns.engine.evaluate_options.find_config", press)
    status, printed = run_main(["evaluate", str(tmp_path)], capsys)
    assert (status, printed) == (130, "")


def test_another_painting_is_not_measured_into_the_runs_own_report(tmp_path, capsys):
    (tmp_path / "config.yml").write_text("method_name: hier-style\n")
    message, _ = run_main(["evaluate", str(tmp_path), "--style-image", "other.jpg"], capsys)
    assert message.startswith("Error: evaluation.json in the run's folder is for its own painting;")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("effects --data fern llff-data --eval-interval 4", "effects --data fern -- llff-data --eval-interval 4"),
        ("effects --data fern -- llff-data --eval-interval 4", None),
        ("effects llff-data --data fern", None),
        ("effects --data fern llff-data", None),
        ("effects --data colmap --json", None),
        ("gallery colmap --evaluate", None),
        ("tradeoff --data x colmap --colmap-path sparse/0", "tradeoff --data x -- colmap --colmap-path sparse/0"),
        ("--help", None),
        ("", None),
    ],
)
def test_options_of_a_dataparser_need_no_dashes_before_it(given, expected):
    assert with_dashes(given.split()) == (expected or given).split()
