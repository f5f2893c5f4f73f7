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
    if options.format == "mesh" or options.mesh:  # found out before the minutes of rendering; others need no Open3D
        from sparsestyle_ns.export.mesh import colored_mesh, export_mesh, make_mesh
    scenes = load_scenes(list(map(find_config, options.runs)))
    scene = scenes[0]
    if options.format == "html":
        export_page(scenes, options.output_path, options.resolution)
    elif options.format == "ply":
        export_points(scene, options.output_path)
    elif options.format == "mesh":
        export_mesh(scene, options.output_path)
    else:
        form = "sh0" if options.sh0 and options.format == "splat" else options.format
        mesh = colored_mesh(make_mesh(scene)) if options.mesh else None
        export_splats(scene, options.output_path, form, options.max_splats, mesh)
    finish(options.output_path.resolve(), after_export(options.runs[0], options.output_path, options.format))
