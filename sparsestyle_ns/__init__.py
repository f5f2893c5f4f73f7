"""Stylised 3D scenes from three to eight photos and one painting, as nerfstudio methods."""

__version__ = "0.1.0"
