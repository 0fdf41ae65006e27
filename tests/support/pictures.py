# SPDX-License-Identifier: Apache-2.0
"""Pictures as independent readers see them: Pillow and an XML parser."""

from __future__ import annotations

import base64
import io
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from PIL import Image

SVG = "{http://www.w3.org/2000/svg}"


def png_pixels(png: bytes, mode: str = "") -> NDArray[Any]:
    """Return the pixels of a PNG, (rows, columns[, channels]); if a mode of Pillow is given, in it."""
    with Image.open(io.BytesIO(png)) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert(mode) if mode else image)


def rasters(root: ElementTree.Element) -> list[tuple[NDArray[np.uint8], list[float]]]:
    """Return the RGBA pixels of each embedded raster, and its left, top, width and height."""
    found = []
    for image in root.iter(f"{SVG}image"):
        if "image-rendering" in image.attrib:
            pixels = png_pixels(base64.b64decode(image.attrib["href"].partition(",")[2]), "RGBA")
            found.append((pixels, [float(image.attrib[name]) for name in ("x", "y", "width", "height")]))
    return found
