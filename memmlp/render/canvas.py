"""A sheet of panels with text and a colour bar, exact to the pixel, and the colours of a GIF."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.image import FigureImage
from matplotlib.text import Text
from PIL import Image

from memmlp.render.error_colours import HEAT, NEUTRAL, heat

DPI = 100
INK, FAINT = "#1b1f24", "#5c6670"


class Sheet:
    """A white picture of width x height pixels; positions are in pixels from the upper left corner."""

    def __init__(self, width: int, height: int):
        self.height = height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)

    def panel(self, x: int, y: int, width: int, height: int) -> FigureImage:
        """Add a panel for pictures (height, width, 3), uint8, which are set by its `set_data`."""
        empty = np.full((height, width, 3), 255, np.uint8)
        return self.figure.figimage(empty, x, self.height - y - height)

    def text(self, x: float, y: float, text: str, size: float, **style: Any) -> Text:
        """Add a text, anchored at a position; `size` is in pixels."""
        width = self.figure.get_figwidth() * DPI
        style = {"color": INK, "va": "center", "ha": "center"} | style
        return self.figure.text(x / width, 1 - y / self.height, text, fontsize=0.72 * size, **style)

    def colour_bar(self, x: int, y: int, width: int, height: int, top: float) -> None:
        """Add the scale of errors from 0 to `top` cm."""
        whole = self.figure.get_figwidth() * DPI
        place = (x / whole, 1 - (y + height) / self.height, width / whole, height / self.height)
        axes = self.figure.add_axes(place)
        colours = LinearSegmentedColormap.from_list("heat", HEAT)
        scalar = matplotlib.cm.ScalarMappable(Normalize(0, top), colours)
        bar = self.figure.colorbar(scalar, cax=axes, ticks=np.linspace(0, top, 6))
        bar.outline.set_visible(False)  # type: ignore[operator]
        bar.set_label("error of a joint [cm]", fontsize=10, color=INK)
        axes.tick_params(labelsize=9, color=FAINT, labelcolor=INK)

    def pixels(self) -> np.ndarray:
        """Return the sheet (height, width, 3), uint8."""
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3]


def palette() -> Image.Image:
    """Return the 256 colours of all GIF pictures: heat-map and truth in light and shadow, and greys.

    With the same palette in all pictures, the film does not flicker.
    """
    heats = shades(heat(np.linspace(0, 1, 28)), 7)
    colours = np.concatenate([heats, shades(np.array([NEUTRAL]), 36), shades(np.ones((1, 3)), 24)])
    image = Image.new("P", (1, 1))
    image.putpalette((255 * np.clip(colours, 0, 1) + 0.5).astype(np.uint8).tobytes())
    return image


def shades(colours: np.ndarray, count: int) -> np.ndarray:
    """Return each colour of (n, 3) from dark to light, as (n * count, 3)."""
    return (np.linspace(0.3, 1, count)[:, None, None] * colours).reshape(-1, 3)


def indexed(picture: np.ndarray) -> Image.Image:
    """Return a picture (H, W, 3), uint8, in the colours of `palette`."""
    return Image.fromarray(picture).quantize(palette=palette(), dither=Image.Dither.NONE)


def png(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3), uint8, as PNG."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()
