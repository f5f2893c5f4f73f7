"""Renders a sample scene, so that everything can be tried without downloading anything.

    python data_scripts/make_sample_scene.py OUTPUT                      # OUTPUT/llff and OUTPUT/blender
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --width 504
    python data_scripts/make_sample_scene.py OUTPUT --layout blender --num-train 40
    python data_scripts/make_sample_scene.py OUTPUT --layout nerfstudio --distortion 0.1
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --shiny 0.6 --exposure 0.5
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --haze 0.3

OUTPUT/llff holds forward-facing photos of a still life in a room (images/, poses_bounds.npy). OUTPUT/blender holds
RGBA pictures of objects on a plinth, seen from all around (train/, val/, test/, transforms_*.json). OUTPUT/nerfstudio
holds photos of the same objects on a ground with things far away behind them (images/, transforms.json). The same seed
gives the same files.
"""

import sys
from typing import Optional, Sequence

from _command_line import exit_status, parse, print_made
from _new_folder import new_folder
from sample_scene.writers import WRITERS, Settings


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    settings = parse(Settings, __doc__, arguments)
    layouts = ("llff", "blender") if settings.layout == "both" else (settings.layout,)

    def make() -> None:
        for layout in layouts:
            target = settings.output / layout
            with new_folder(target, settings.force) as folder:
                WRITERS[layout](folder, settings)
            print_made(target, ["ns-train", "coarse-fewshot-draft", "--data", target, f"{layout}-data"])

    return exit_status(make)


if __name__ == "__main__":
    sys.exit(main())
