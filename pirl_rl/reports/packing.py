"""Numbers, pictures and programs as text in a page.

The page unpacks what `compressed` packed with the browser's own decompression of gzip.
"""

from __future__ import annotations

import base64
import gzip
import io
from pathlib import Path

import numpy as np
from PIL import Image

WIDTHS = (1200, 900, 640, 420)
"""The widths of pictures in pixels that are tried, from the widest down."""

QUALITY = 82
"""The quality of pictures, of at most 100."""


def compressed(data: bytes) -> str:
    """Bytes as text, the same for the same bytes."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")


def packed(codes: np.ndarray) -> str:
    """An array of unsigned integers of 8 or 16 bits as text.

    Differences of neighbours, which a compressor likes better than smooth numbers, are written in one plane of bytes
    for each byte of a number, the higher one first.
    """
    flat = codes.reshape(-1)
    steps = np.diff(flat, prepend=flat.dtype.type(0))  # modulo 2^bits
    planes = steps.astype(f">u{flat.dtype.itemsize}").view(np.uint8).reshape(-1, flat.dtype.itemsize)
    return compressed(np.ascontiguousarray(planes.T).tobytes())


def quantised(values: np.ndarray, low: float, high: float, largest: int, bits: int = 8) -> np.ndarray:
    """The nearest of the numbers 0 to `largest` to values between `low` and `high`, as integers of so many bits."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.rint(np.nan_to_num(share) * largest).astype(f"u{bits // 8}")


def pictures(paths: list[Path], most: int) -> dict[str, dict]:
    """Pictures as addresses that hold them, with their sizes in pixels, by the names of their files without ending.

    All get the same largest width, the first of `WIDTHS` with which they have at most `most` characters together. With
    the last one they are kept in any case as far as they fit.

    Raises:
        OSError: a file is no picture.
    """
    found: dict[str, dict] = {}
    for width in WIDTHS:
        found = {path.stem: _picture(path, width) for path in paths}
        if sum(len(entry["address"]) for entry in found.values()) <= most:
            return found
    total, kept = 0, {}
    for name, entry in found.items():
        total += len(entry["address"])
        if total <= most:
            kept[name] = entry
    return kept


def _picture(path: Path, width: int) -> dict:
    with Image.open(path) as image:
        picture = image.convert("RGB")
    if picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "WEBP", quality=QUALITY, method=4)
    text = base64.b64encode(data.getvalue()).decode("ascii")
    return {"address": f"data:image/webp;base64,{text}", "width": picture.width, "height": picture.height}
