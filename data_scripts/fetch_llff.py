"""Fetches a forward-facing scene in the LLFF layout: `images/` and `poses_bounds.npy`.

    python data_scripts/fetch_llff.py data/llff                     # fern, from the NeRF authors' example data
    python data_scripts/fetch_llff.py data/llff --scene flower --url file:///downloads/nerf_llff_data.zip

The example data holds only fern. With `--url`, any zip archive that holds a folder of the scene's name with a
`poses_bounds.npy` in it will do.
"""

import sys
from typing import Optional, Sequence

from _command_line import parse
from _download import FetchOptions, run


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    return run(parse(FetchOptions, __doc__, arguments), "poses_bounds.npy", "llff-data")


if __name__ == "__main__":
    sys.exit(main())
