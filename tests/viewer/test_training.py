"""The Style panel while ns-train trains."""

import signal
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable, List

import pytest
import torch
from conftest import TINY_STYLE, ns_train, only_run

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.style_trainer import HierStyleTrainer
from sparsestyle_ns.runs.checkpoints import newest_checkpoint
from sparsestyle_ns.utils.interrupts import StoppedByCtrlC


def flags_of(runs: SimpleNamespace, painting: Path, iterations: int) -> List[str]:
    """Those of a short stage 2."""
    length = ["--max-num-iterations", str(iterations)]
    return ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE, *length]


def train_with_viewer(
    runs: SimpleNamespace,
    scene: Path,
    painting: Path,
    outputs: Path,
    monkeypatch: pytest.MonkeyPatch,
    act: Callable[[Any], None],
    at_step: int,
    iterations: int = 3,
) -> Path:
    """Trains with the viewer, and has `act(trainer)` called in another thread at a step.

    Training is paused, as by the viewer's button, when that thread begins.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    seen, failures, train_iteration = [], [], HierStyleTrainer.train_iteration

    def work(trainer: Any) -> None:
        try:
            act(trainer)
        except Exception as failure:
            failures.append(failure)
        trainer.training_state = "training"

    def iterate(trainer: Any, step: int) -> Any:
        result = train_iteration(trainer, step)
        if step == at_step:
            seen.append(trainer)
            trainer.viewer_state._toggle_training_state(None)
            threading.Thread(target=work, args=(trainer,), daemon=True).start()
        return result

    monkeypatch.setattr(HierStyleTrainer, "train_iteration", iterate)
    monkeypatch.setattr("sparsestyle_ns.viewer.restyling_controls.SECONDS_BETWEEN_TEXTS", 0.0)
    viewer = ["--viewer.websocket-port", str(port), "--viewer.websocket-host", "127.0.0.1"]
    viewer += ["--vis", "viewer+tensorboard"]
    try:
        with suppress(StoppedByCtrlC):
            ns_train("hier-style", scene, outputs, *flags_of(runs, painting, iterations), *viewer)
    finally:
        for trainer in seen:
            trainer.viewer_state.viser_server.stop()
    assert len(seen) == 1
    if failures:
        raise failures[0]
    return seen[0].base_dir


def test_losses_are_shown_pausing_pauses_and_a_restyling_leaves_training_as_it_is(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    ns_train("hier-style", llff_scene, tmp_path / "b", *flags_of(runs, painting, 3))
    undisturbed = only_run(tmp_path / "b", "hier-style")

    def act(trainer: Any) -> None:
        panel = trainer.pipeline.panel
        assert panel.training.content.startswith("Iteration 2 of 3: content ")
        assert panel.styles[0].facts[0] == ("Painting", "painting.png")
        assert any(name == "Features" for name, _ in panel.styles[0].facts)
        panel.restyling.path.value = str(painting)
        panel.restyling.restyle_path()
        end = time.monotonic() + 60
        while panel.restyling.is_busy:
            assert time.monotonic() < end
            time.sleep(0.05)
        told.append(panel.restyling.message.content)
        # Paused all the while, before the third iteration.
        assert trainer.step == 2 and panel.training.content.startswith("Iteration 2 of 3")

    run = train_with_viewer(runs, llff_scene, painting, tmp_path / "a", monkeypatch, act, at_step=1, iterations=3)
    (message,) = told
    assert "**painting 2** is ready" in message
    (saved,) = (folder for folder in run.parent.iterdir() if folder != run)
    _, pipeline, _ = load_run(saved / "config.yml")
    assert pipeline.config.coarse_run == runs.coarse.resolve()
    states = [newest_checkpoint(folder / "nerfstudio_models") for folder in (run, undisturbed)]
    found, expected = (torch.load(path, weights_only=True)["pipeline"] for path in states)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


def test_ctrl_c_ends_a_paused_run_with_a_checkpoint(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def act(trainer: Any) -> None:
        time.sleep(0.2)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(1.0)

    run = train_with_viewer(runs, llff_scene, painting, tmp_path, monkeypatch, act, at_step=1, iterations=50)
    assert [path.name for path in (run / "nerfstudio_models").iterdir()] == ["step-000000002.ckpt"]


def test_a_run_keeps_a_thumbnail_of_its_painting(runs: SimpleNamespace) -> None:
    assert (runs.style / "style_thumbnail.jpg").read_bytes().startswith(b"\xff\xd8")
