"""The viewer shows a file of splats in the world of its picture."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from viser import ViserServer

from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.export.splat_file import encode_splats
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.viewer.splat_controls import SplatControls, read_splats


@pytest.fixture
def gaussians():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(20, 14, generator=generator)
    rows[:, 11:] = torch.rand(20, 3, generator=generator)
    return Gaussians(rows)


@pytest.fixture
def server():
    server = ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.mark.parametrize("small", [False, True])
def test_a_file_is_read_as_it_was_written(gaussians, small, tmp_path):
    (tmp_path / "splats.ply").write_bytes(encode_splats(gaussians, small))
    splats = read_splats(tmp_path / "splats.ply")
    np.testing.assert_allclose(splats.centers, gaussians.means)
    np.testing.assert_allclose(splats.rgbs, gaussians.colors, atol=1e-6)
    np.testing.assert_allclose(splats.opacities[:, 0], gaussians.logits.sigmoid(), atol=1e-6)
    variances = np.sort(np.exp(2.0 * gaussians.log_scales.double().numpy()), axis=-1)
    np.testing.assert_allclose(np.linalg.eigvalsh(splats.covariances), variances, rtol=1e-4)
    # The first axis is where the quaternion turns x to.
    w, x, y, z = torch.nn.functional.normalize(gaussians.rotations.double(), dim=-1).unbind(-1)
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    along = np.einsum("ni,nij,nj->n", first, splats.covariances, first)
    np.testing.assert_allclose(along, np.exp(2.0 * gaussians.log_scales[:, 0].double()), rtol=1e-4)


def test_another_file_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "points.ply").write_bytes(b"ply\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0")
    with pytest.raises(InputError, match="is no file of splats; export the run with --format splat"):
        read_splats(tmp_path / "points.ply")
    with pytest.raises(InputError, match=r"can't be read \(No such file"):
        read_splats(tmp_path / "none.ply")


def test_the_checkbox_shows_and_hides_them(gaussians, server, tmp_path):
    controls = SplatControls(server, tmp_path)
    controls.shown.value = True
    controls.show()
    assert "read" in controls.message.content and controls.message.visible
    (tmp_path / "splats.ply").write_bytes(encode_splats(gaussians))
    controls.show()
    assert controls.message.content == "20 splats" and controls._node.visible
    controls.shown.value = False
    controls.show()
    assert controls._node is None and not controls.message.visible


def test_a_viser_that_shows_no_splats_is_named(server):
    bare = SimpleNamespace(scene=SimpleNamespace(), gui=server.gui)
    assert SplatControls(bare, Path()).message.content == "This version of viser shows no splats."
