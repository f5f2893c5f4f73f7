"""`sparsestyle export`: from a run to a file that needs no Python."""

from sparsestyle_ns.engine.hints import after_export, finish
from sparsestyle_ns.export.export_options import ExportOptions
from sparsestyle_ns.export.points import export_points
from sparsestyle_ns.export.splats import export_splats
from sparsestyle_ns.export.stylised_scene import load_scenes
from sparsestyle_ns.export.web_page import export_page
from sparsestyle_ns.runs.run_folder import find_config


def export_run(options: ExportOptions) -> None:
    """Writes the file that checked options ask for, and prints how close it comes to the exact render.

    Raises an `InputError` if a run has no checkpoint, two can't be blended, the scene can't be written so, or Open3D
    can't be loaded.
    """
    as_mesh = options.format == "mesh" or options.mesh
    if as_mesh:  # found out before the minutes of rendering; other formats work without Open3D
        from sparsestyle_ns.export.mesh import export_mesh
    scenes, glb = load_scenes(list(map(find_config, options.runs))), options.format == "glb"
    scene = scenes[0]
    if options.format == "html":
        export_page(scenes, options.output_path, options.resolution)
    elif options.format == "ply":
        export_points(scene, options.output_path)
    elif as_mesh:
        export_mesh(scene, options.output_path, glb)
    else:
        export_splats(scene, options.output_path, options.max_splats, options.sh0, glb)
    finish(options.output_path.resolve(), after_export(options.runs[0], options.output_path, options.format))
