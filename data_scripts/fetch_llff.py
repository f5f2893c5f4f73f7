"""Fetches a forward-facing scene in the LLFF layout: `images/` and `poses_bounds.npy`.

    python data_scripts/fetch_llff.py data/llff                     # fern, from the NeRF authors' example data
    python data_scripts/fetch_llff.py data/llff --scene flower --url file:///downloads/nerf_llff_data.zip

The example data holds only fern. With `--url`, any zip archive that holds a folder of the scene's name with a
`poses_bounds.npy` in it will do.
"""

import argparse
import sys
from typing import Optional, Sequence

from _download import add_common_arguments, run


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    parser = argparse.ArgumentParser(description="Fetches a forward-facing scene in the LLFF layout.")
    add_common_arguments(parser, default_scene="fern")
    return run(parser, "poses_bounds.npy", "llff-data", arguments)


if __name__ == "__main__":
    sys.exit(main())
