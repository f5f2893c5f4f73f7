"""Gaussians are drawn, and learn, as the obvious loop over them says; files of them are what other programs read."""

import gzip
import importlib.util
import io
import json
import math
import re
import struct

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from plyfile import PlyData
from small_scenes import psnr, scene

from sparsestyle_ns.cli import main
from sparsestyle_ns.export import splats
from sparsestyle_ns.export.fit_gaussians import LEAST_SIZE, fit_gaussians, least_log_scales
from sparsestyle_ns.export.gaussians import DRAWINGS, Gaussians, picture_of_gaussians
from sparsestyle_ns.export.gltf import GLTF_SPLAT_BYTES, ColoredMesh, encode_gltf
from sparsestyle_ns.export.place_gaussians import SeenView, jacobians, place_gaussians, quaternions
from sparsestyle_ns.export.splat_file import CONSTANT_HARMONIC, encode_splats
from sparsestyle_ns.export.splat_kernels import MAX_ALPHA, MIN_ALPHA, REACH
from sparsestyle_ns.export.splats import most_splats
from sparsestyle_ns.export.voxel_grid import ray_segments

needs_gsply = pytest.mark.skipif(importlib.util.find_spec("gsply") is None, reason="gsply isn't installed")

NUMBER = 40
BACKGROUND = torch.tensor([1.0, 0.5, 0.2])


def rotations(quaternion):
    """Of quaternions (w, x, y, z), by p → q p q*."""
    w, *vector = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    v = torch.stack(vector, dim=-1)
    axes = torch.eye(3).to(v).expand(len(v), 3, 3)
    across = 2.0 * torch.linalg.cross(v[:, None].expand_as(axes), axes)
    turned = axes + w[:, None, None] * across + torch.linalg.cross(v[:, None].expand_as(axes), across)
    return turned.mT


def random_gaussians():
    generator = torch.Generator().manual_seed(1)
    parts = [torch.randn(NUMBER, count, generator=generator) for count in (3, 3, 4, 1)]
    means = 0.7 * parts[0] - torch.tensor([0.0, 0.0, 4.0])
    colors = torch.rand(NUMBER, 3, generator=generator)
    return torch.cat([means, 0.5 * parts[1] - 2.0, parts[2], 2.0 * parts[3] + 1.0, colors], dim=-1)


def camera():
    """One that looks a little aside, with its centre out of the middle."""
    pose = torch.cat([rotations(torch.tensor([[1.0, 0.05, -0.1, 0.07]]))[0], torch.tensor([[0.1], [0.2], [0.3]])], -1)
    return Cameras(pose[None], fx=30.0, fy=33.0, cx=15.0, cy=13.0, width=32, height=24)


def drawn_one_by_one(rows, camera, drawing):
    """All Gaussians at all pixels, in torch."""
    pose, focal = camera.camera_to_worlds[0], torch.tensor([float(camera.fx), -float(camera.fy)])
    x, y, z = ((rows[:, :3] - pose[:, 3]) @ pose[:, :3]).unbind(-1)
    center = torch.tensor([float(camera.cx), float(camera.cy)]) - focal * torch.stack([x, y], -1) / z[:, None]
    zero = torch.zeros_like(z)
    jacobian = torch.stack([torch.stack([-1 / z, zero, x / z**2], -1), torch.stack([zero, -1 / z, y / z**2], -1)], -2)
    half_axes = focal[:, None] * jacobian @ pose[:, :3].T @ (rotations(rows[:, 6:10]) * rows[:, None, 3:6].exp())
    sharp = half_axes @ half_axes.mT
    spread = sharp + drawing.blur * torch.eye(2)
    opacity = rows[:, 10].sigmoid()
    if drawing.sharpened:
        opacity = opacity * (torch.linalg.det(sharp) / torch.linalg.det(spread)).sqrt()
    height, width = int(camera.height), int(camera.width)
    pixels = torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), dim=-1) + 0.5
    picture, light = torch.zeros(height, width, 3), torch.ones(height, width, 1)
    for number in (-z).argsort().tolist():
        if z[number] > -0.01:
            continue
        offset = pixels - center[number]
        q = (offset @ torch.linalg.inv(spread[number]) * offset).sum(dim=-1, keepdim=True)
        alpha = opacity[number] * (torch.exp(-0.5 * q) - drawing.foot) / (1.0 - drawing.foot)
        # Where a bell is lowered, it is drawn as far as it would be otherwise.
        reached = (q < REACH**2) & (opacity[number] * torch.exp(-0.5 * q) >= MIN_ALPHA) & (light >= 1e-4)
        alpha = torch.where(reached, alpha.clamp(max=MAX_ALPHA), 0.0)
        picture = picture + light * alpha * rows[number, 11:]
        light = light * (1.0 - alpha)
    return picture + light * BACKGROUND


@pytest.mark.parametrize("viewer", DRAWINGS)
def test_the_kernels_draw_and_learn_as_the_loop_does(viewer):
    target = torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(2))
    found = []
    for draw in (
        lambda rows: drawn_one_by_one(rows, camera(), DRAWINGS[viewer]),
        lambda rows: picture_of_gaussians(Gaussians(rows), camera(), BACKGROUND, DRAWINGS[viewer]),
    ):
        rows = random_gaussians().requires_grad_()
        picture = draw(rows)
        (picture - target).square().sum().backward()
        found.append((picture.detach(), rows.grad))
    (expected, gradient), (picture, own_gradient) = found
    torch.testing.assert_close(picture, expected, atol=2e-5, rtol=0)  # the polynomial for exp
    scale = gradient.abs().amax(dim=0)
    torch.testing.assert_close(own_gradient / scale, gradient / scale, atol=2e-4, rtol=0)


def test_quaternions_are_those_of_their_rotations():
    expected = torch.randn(200, 4, generator=torch.Generator().manual_seed(0)).double()
    expected[:4] = torch.eye(4)
    expected[4] = torch.tensor([0.0, 0.6, 0.0, 0.8])
    torch.testing.assert_close(rotations(quaternions(rotations(expected))), rotations(expected), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", ["ndc", "box", "contracted"])
def test_jacobians_are_differences_of_the_map_to_the_world(kind):
    space = scene(kind).model.space
    points = (torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8).double()
    found = jacobians(space, points)
    for axis in range(3):
        step = 1e-6 * torch.eye(3, dtype=torch.float64)[axis]
        difference = (space.to_world(points + step) - space.to_world(points - step)) / 2e-6
        torch.testing.assert_close(found[..., axis], difference, atol=1e-4, rtol=1e-4)


def seen(small, index):
    """What a camera sees of a small scene of voxels, with one sample a ray, where its weight is."""
    view, model = small.cameras[index : index + 1], small.model
    (segments,) = ray_segments(view, model.space)
    rays = len(segments.hit)
    s = torch.linspace(0.0, 1.0, 65)[:-1] + 1 / 128
    points = segments.positions(s.expand(rays, -1))
    codes = small.voxels.styles[0].interpolate(points.reshape(-1, 3)).view(rays, -1, 4)
    depth = 0.01 * torch.expm1(math.log1p(1e7) / 254 * (codes[..., 0] - 1.0))
    depth = depth * segments.lengths(torch.linspace(0.0, 1.0, 65).expand(rays, -1)) * segments.hit[:, None]
    light = torch.exp(-torch.cat([torch.zeros(rays, 1), depth.cumsum(-1)[:, :-1]], dim=-1))
    weights = light * -torch.expm1(-depth)
    kept = weights > 1e-3
    colors = codes[..., 1:] / 255.0
    background = torch.zeros(3) if model.background is None else model.background
    picture = (weights[..., None] * colors).sum(1) + (1.0 - weights.sum(1, keepdim=True)) * background
    size = int(view.height), int(view.width), 3
    return SeenView(
        view, picture.view(size), points[kept], depth[kept], weights[kept], colors[kept], kept.nonzero()[:, 0]
    )


@pytest.mark.parametrize("kind", ["ndc", "box"])
def test_gaussians_come_to_look_as_the_scene_does_from_a_place_in_between(kind):
    small = scene(kind)
    views = [seen(small, index) for index in range(3)]
    placed = place_gaussians(small.model.space, views, 4000)
    assert 1000 < len(placed) <= 4000
    fitted = fit_gaussians(placed, views, small.model.background, 60)
    for drawing in DRAWINGS.values():
        before, after = (
            psnr(picture_of_gaussians(each, views[1].camera, small.model.background, drawing), views[1].picture)
            for each in (placed, fitted)
        )
        assert after > max(before + 3.0, 25.0)
    assert (fitted.log_scales >= least_log_scales(placed, views) - 1e-4).all()
    assert fitted.colors.min() > -1e-5
    assert fitted.colors.max() < 1 + 1e-5


def test_no_gaussian_is_smaller_than_its_share_of_a_pixel():
    rows = random_gaussians()
    least = least_log_scales(Gaussians(rows), [SeenView(camera(), *[torch.zeros(0)] * 6)])[:, 0].exp()
    pose = camera().camera_to_worlds[0]
    depth = (pose[:, 3] - rows[:, :3]) @ pose[:, 2]
    inside = least > 0
    assert 10 < inside.sum() < NUMBER
    torch.testing.assert_close(least[inside], LEAST_SIZE * depth[inside] / 30.0)


REFERENCE_FIELDS = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{number}" for number in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


@pytest.mark.parametrize("small", [False, True])
def test_a_file_of_splats_has_the_reference_s_fields_in_their_order(small):
    rows = random_gaussians()
    vertices = PlyData.read(io.BytesIO(encode_splats(Gaussians(rows), small)))["vertex"]
    names = [each.name for each in vertices.properties]
    assert names == [name for name in REFERENCE_FIELDS if not (small and name.startswith("f_rest"))]
    assert len(names) == (17 if small else 62)
    read = {name: torch.tensor(np.array(vertices[name])) for name in names}
    torch.testing.assert_close(torch.stack([read[name] for name in "xyz"], -1), rows[:, :3])
    color = 0.5 + CONSTANT_HARMONIC * torch.stack([read[f"f_dc_{number}"] for number in range(3)], -1)
    torch.testing.assert_close(color, rows[:, 11:])
    torch.testing.assert_close(read["opacity"], rows[:, 10])
    torch.testing.assert_close(torch.stack([read[f"scale_{number}"] for number in range(3)], -1), rows[:, 3:6])
    turn = torch.stack([read[f"rot_{number}"] for number in range(4)], -1)
    torch.testing.assert_close(turn, torch.nn.functional.normalize(rows[:, 6:10], dim=-1))


def test_without_a_wish_as_many_splats_are_written_as_fit_into_30_megabytes():
    rows = random_gaussians()
    for floats, small in ((62, False), (17, True)):
        most = most_splats(None, 4 * floats)
        header = len(encode_splats(Gaussians(rows), small)) - 4 * floats * NUMBER
        assert most <= 400_000
        assert header + 4 * floats * most <= 30_000_000
    assert most_splats(None, 68) == 400_000
    assert most_splats(500_000, 248) == 500_000
    assert most_splats(None, 60, taken=12_000_000) == (18_000_000 - 2000) // 60


def parts_of(glb):
    """The description and the numbers of a .glb file."""
    magic, version, length = struct.unpack_from("<4sII", glb)
    assert (magic, version, length) == (b"glTF", 2, len(glb))
    size, kind = struct.unpack_from("<I4s", glb, 12)
    assert kind == b"JSON"
    more, kind = struct.unpack_from("<I4s", glb, 20 + size)
    assert kind == b"BIN\0"
    assert 28 + size + more == len(glb)
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]


def numbers_of(told, data, index):
    accessor = told["accessors"][index]
    view = told["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5121: "u1", 5125: "<u4"}[accessor["componentType"]]
    part = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return torch.from_numpy(np.frombuffer(part, kind).reshape(accessor["count"], -1).astype(np.float32))


def test_gaussians_as_gltf_are_points_that_the_extension_describes():
    rows = random_gaussians()
    told, data = parts_of(encode_gltf([Gaussians(rows)], scene("box").model.space))
    assert told["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert told["nodes"][0]["rotation"] == pytest.approx([-(0.5**0.5), 0, 0, 0.5**0.5])  # z up becomes y up
    (primitive,) = told["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    read = {name: numbers_of(told, data, index) for name, index in primitive["attributes"].items()}
    prefix = "KHR_gaussian_splatting:"
    torch.testing.assert_close(read["POSITION"], rows[:, :3])
    torch.testing.assert_close(read[prefix + "SCALE"], rows[:, 3:6].exp())
    torch.testing.assert_close(read[prefix + "OPACITY"][:, 0], rows[:, 10].sigmoid())
    turn = torch.nn.functional.normalize(rows[:, 6:10], dim=-1)[:, [1, 2, 3, 0]]
    torch.testing.assert_close(read[prefix + "ROTATION"], turn)
    torch.testing.assert_close(0.5 + CONSTANT_HARMONIC * read[prefix + "SH_DEGREE_0_COEF_0"], rows[:, 11:])
    torch.testing.assert_close(read["COLOR_0"][:, :3] / 255, rows[:, 11:], atol=0.5 / 255, rtol=0)


def test_a_mesh_as_gltf_has_linear_colours_and_needs_no_light():
    corners = np.eye(3)
    mesh = ColoredMesh(corners, corners, np.array([[0.0, 0.5, 1.0]] * 3), np.array([[0, 1, 2]]))
    told, data = parts_of(encode_gltf([mesh], scene("ndc").model.space))
    assert "rotation" not in told["nodes"][0]  # forward-facing worlds have y up already
    (primitive,) = told["meshes"][0]["primitives"]
    assert told["materials"][primitive["material"]]["extensions"] == {"KHR_materials_unlit": {}}
    assert numbers_of(told, data, primitive["indices"])[:, 0].tolist() == [0, 1, 2]
    color = numbers_of(told, data, primitive["attributes"]["COLOR_0"])[0]
    torch.testing.assert_close(color, torch.tensor([0.0, 0.2140, 1.0]), atol=1e-4, rtol=0)


def test_splats_and_a_mesh_are_two_nodes_of_one_file_that_takes_what_is_said():
    corners = np.eye(3)
    mesh = ColoredMesh(corners, corners, corners, np.array([[0, 1, 2]]))
    told, data = parts_of(encode_gltf([Gaussians(random_gaussians()), mesh], scene("box").model.space))
    assert told["scenes"][0]["nodes"] == [0, 1]
    assert [(node["name"], node["mesh"]) for node in told["nodes"]] == [("Splats", 0), ("Mesh", 1)]
    assert told["nodes"][0]["rotation"] == told["nodes"][1]["rotation"]
    assert [mesh["primitives"][0]["mode"] for mesh in told["meshes"]] == [0, 4]
    assert len(data) == GLTF_SPLAT_BYTES * NUMBER + mesh.bytes_in_gltf


@needs_gsply
@pytest.mark.parametrize("kind", ["ndc", "box"])
def test_gaussians_as_spz_are_rounded_and_stand_with_y_up(kind):
    from sparsestyle_ns.export.spz_file import decode_spz, encode_spz

    rows, space = random_gaussians(), scene(kind).model.space
    content = encode_spz(Gaussians(rows), space)
    plain = gzip.decompress(content)
    magic, version, number, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", plain)
    assert (magic, version, number, degree, flags) == (b"NGSP", 3, NUMBER, 0, 0)
    assert len(plain) == 16 + 20 * NUMBER
    first = np.frombuffer(plain[16:25], np.uint8).reshape(3, 3).astype(np.int64) @ [1, 1 << 8, 1 << 16]
    x, y, z = np.where(first >= 1 << 23, first - (1 << 24), first) / 2.0**bits
    expected = rows[0, :3].tolist()
    assert ([x, y, z] if kind == "ndc" else [x, -z, y]) == pytest.approx(expected, abs=1e-5)
    read = decode_spz(content, space).rows
    assert float((read[:, :3] - rows[:, :3]).abs().max()) < 2e-6
    assert float((read[:, 3:6] - rows[:, 3:6]).abs().max()) < 0.5 / 16 + 1e-5
    torch.testing.assert_close(rotations(read[:, 6:10]), rotations(rows[:, 6:10]), atol=0.01, rtol=0)
    torch.testing.assert_close(read[:, 10].sigmoid(), rows[:, 10].sigmoid(), atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(read[:, 11:], rows[:, 11:], atol=0.004, rtol=0)


@pytest.mark.parametrize("form", ["splat", "glb", pytest.param("spz", marks=needs_gsply)])
def test_the_command_writes_splats_and_says_how_far_they_are_from_the_exact_render(
    form, patterned_run, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(splats, "STEPS", 20)
    path = tmp_path / "scene.file"
    options = ["--format", form, "--output-path", str(path), "--max-splats", "1500"]
    main(["export", str(patterned_run), *options])
    printed = capsys.readouterr().out
    number = int(re.search(r"([\d,]+) splats", printed)[1].replace(",", ""))
    assert 100 < number <= 1500
    if form == "splat":
        assert PlyData.read(str(path))["vertex"].count == number
    elif form == "glb":
        assert parts_of(path.read_bytes())[0]["accessors"][0]["count"] == number
    else:
        assert struct.unpack_from("<I", gzip.decompress(path.read_bytes()), 8) == (number,)
    assert re.search(r"PSNR to the exact render, held-out view of \S+: [\d.]+ dB", printed)
    assert re.search(r"Mean of the held-out views at 32 × 24, drawn as .+: [\d.]+ dB \(as ", printed)
