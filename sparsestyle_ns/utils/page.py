"""HTML pages of this package: one file that needs nothing else, made from Jinja2 templates."""

import base64
import io

import numpy as np
from jaxtyping import UInt8
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from PIL import Image

Pixels = UInt8[np.ndarray, "H W 3"]

LOSSLESS_PIXELS = 200_000
"""Pictures with at most this many pixels go into a page as PNG, larger ones as JPEG."""


def render_page(template: str, package: str, **values: object) -> str:
    """A whole page from a Jinja2 template, a file in the folder `templates` of a package, filled with escaped `values`.

    Templates have the filters `pixels | data_uri` and `content | bytes_uri("video/mp4")`.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("sparsestyle_ns.utils")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(data_uri=data_uri, bytes_uri=bytes_uri)
    return environment.get_template(template).render(**values)


def data_uri(pixels: Pixels) -> str:
    """A picture as a data URI: PNG, or JPEG where PNG would be heavy."""
    form = "png" if pixels.shape[0] * pixels.shape[1] <= LOSSLESS_PIXELS else "jpeg"
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form, optimize=True, quality=90)  # each takes the option that it knows
    return bytes_uri(buffer.getvalue(), f"image/{form}")


def bytes_uri(content: bytes, media_type: str) -> str:
    """A file's bytes as a data URI, of a media type such as video/mp4 or image/svg+xml."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"
