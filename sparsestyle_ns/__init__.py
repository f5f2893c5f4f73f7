"""Stylised 3D scenes from three to eight photos and one painting, as nerfstudio methods."""

from sparsestyle_ns.utils.interrupts import guard_nerfstudio

__version__ = "0.1.0"

guard_nerfstudio(("coarse-fewshot", "hier-style"))  # here, as nerfstudio still loads for seconds after this
