"""Stylised 3D scenes from three to eight photos and one painting, as nerfstudio methods."""

import warnings

from sparsestyle_ns.utils.interrupts import guard_nerfstudio

__version__ = "0.1.0"

# What nerfstudio's own code will have to change for later versions of torch is nothing that our users can mend.
warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")

guard_nerfstudio(("coarse-fewshot", "hier-style"))  # here, as nerfstudio still loads for seconds after this
