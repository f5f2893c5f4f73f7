"""A coloured mesh of a scene's surfaces, made as nerfstudio's `ns-export poisson` makes one, with Open3D.

The points are those of the training views, not of random rays, and every vertex has the colour of the points around it.
Importing this module raises an `InputError` where Open3D can't be loaded.
"""

from pathlib import Path
from typing import Tuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.export.gltf import ColoredMesh
from sparsestyle_ns.export.points import Points, joined, likeness, print_likeness, surfaces
from sparsestyle_ns.export.stylised_scene import StylisedScene
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output
from sparsestyle_ns.utils.ply import RGB, encode_ply, floats

try:
    import open3d
except (ImportError, OSError) as error:
    raise InputError(
        f"Open3D, which makes the mesh, can't be loaded ({error}): install the libraries that it needs, on Debian and "
        "Ubuntu with apt-get install libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6, or choose --format ply."
    ) from error

OCTREE_DEPTH = 9
"""Levels of the Poisson solver's octree, as in `ns-export poisson`."""
THIN_SHARE = 0.1
"""Share of the vertices, those with the fewest points around them, that are dropped (as in `ns-export poisson`)."""
NORMAL_NEIGHBOURS = 30
FAR = 4.0
"""Vertices farther from any point than this many times the points' median distance from each other are dropped: the
reconstruction closes holes with them."""


def export_mesh(scene: StylisedScene, output_path: Path) -> None:
    """Writes a mesh with coloured vertices as PLY, and prints how well it shows each training view."""
    mesh = make_mesh(scene)
    write_output(output_path, encode_mesh(colored_mesh(mesh)), "The mesh", "scene.ply")


def make_mesh(scene: StylisedScene) -> open3d.geometry.TriangleMesh:
    """A mesh of the surfaces that a scene's training views see; prints how well it shows each of them."""
    pictures, parts = surfaces(scene)
    mesh = poisson_mesh(joined(parts))
    print(f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles")
    print("The mesh without light against the exact render:")
    shown = [picture_of_mesh(mesh, scene.cameras[index : index + 1]) for index in range(len(pictures))]
    print_likeness(scene.names, [likeness(*seen, picture) for seen, picture in zip(shown, pictures, strict=True)])
    return mesh


def poisson_mesh(points: Points) -> open3d.geometry.TriangleMesh:
    """A mesh through surface points, with holes where they are far apart; `InputError` if there are fewer than 100."""
    if (count := len(points.positions)) < 100:
        raise InputError(f"The views show only {count} surface points, too few to mesh; train the coarse field longer.")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.positions.double().numpy()))
    cloud.colors = open3d.utility.Vector3dVector(points.colors.double().numpy())
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    outward = np.einsum("pc,pc->p", normals, (points.origins - points.positions).double().numpy())
    normals[outward < 0] *= -1  # surfaces face the camera that saw them
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=OCTREE_DEPTH, n_threads=1)
    vertices = open3d.geometry.PointCloud(mesh.vertices)
    spacing = float(np.median(cloud.compute_nearest_neighbor_distance()))
    distance = np.asarray(vertices.compute_point_cloud_distance(cloud))
    mesh.remove_vertices_by_mask((density < np.quantile(density, THIN_SHARE)) | (distance > FAR * spacing))
    return mesh


def encode_mesh(mesh: ColoredMesh) -> bytes:
    """A binary PLY file with the vertices' colours and normals."""
    rows = np.empty(len(mesh.positions), dtype=[("place", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    rows["place"], rows["normal"] = mesh.positions, mesh.normals
    rows["color"] = np.rint(255.0 * np.clip(mesh.colors, 0.0, 1.0))
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    properties = (*floats("x", "y", "z", "nx", "ny", "nz"), *RGB)
    return encode_ply(("vertex", properties, rows), ("face", ("list uchar int vertex_indices",), faces))


def colored_mesh(mesh: open3d.geometry.TriangleMesh) -> ColoredMesh:
    """The same mesh in numpy's arrays, which needs no Open3D to be written."""
    mesh.compute_vertex_normals()
    parts = (mesh.vertices, mesh.vertex_normals, mesh.vertex_colors, mesh.triangles)
    return ColoredMesh(*map(np.asarray, parts))


def picture_of_mesh(
    mesh: open3d.geometry.TriangleMesh, camera: Cameras
) -> Tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """What one pinhole camera sees of a mesh without light: colours, and where there are any."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    rays = torch.cat([bundle.origins, bundle.directions], dim=-1).numpy()
    hits = scene.cast_rays(open3d.core.Tensor(rays))
    shown = np.isfinite(hits["t_hit"].numpy())
    corners = np.asarray(mesh.triangles)[hits["primitive_ids"].numpy()[shown]]
    second, third = np.moveaxis(hits["primitive_uvs"].numpy()[shown], -1, 0)
    weights = np.stack([1.0 - second - third, second, third], axis=-1)
    colors = np.zeros((*rays.shape[:2], 3), np.float32)
    colors[shown] = np.einsum("pk,pkc->pc", weights, np.asarray(mesh.vertex_colors)[corners])
    return torch.from_numpy(colors), torch.from_numpy(shown)
