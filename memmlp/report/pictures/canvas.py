"""A sheet of panels with text and a colour bar, exact to the pixel."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from memmlp.motion.limb_shapes import HEAT

if TYPE_CHECKING:
    from matplotlib.image import FigureImage
    from matplotlib.text import Text

DPI = 100
INK, FAINT = "#1b1f24", "#5c6670"


class Sheet:
    """A white picture of width x height pixels; positions are in pixels from the upper left corner."""

    def __init__(self, width: int, height: int):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)

    def panel(self, x: int, y: int, width: int, height: int) -> FigureImage:
        """Add a panel for pictures (height, width, 3), uint8, which its `set_data` takes."""
        empty = np.full((height, width, 3), 255, np.uint8)
        return self.figure.figimage(empty, x, self.height - y - height)

    def text(self, x: float, y: float, text: str, size: float, **style: Any) -> Text:
        """Add a text, anchored at a position; `size` is in pixels."""
        style = {"color": INK, "va": "center", "ha": "center"} | style
        return self.figure.text(x / self.width, 1 - y / self.height, text, fontsize=0.72 * size, **style)

    def colour_bar(self, x: int, y: int, width: int, height: int, top: float) -> None:
        """Add the scale of errors from 0 to `top` cm."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        place = (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        axes = self.figure.add_axes(place)
        scalar = ScalarMappable(Normalize(0, top), LinearSegmentedColormap.from_list("heat", HEAT))
        bar = self.figure.colorbar(scalar, cax=axes, ticks=np.linspace(0, top, 6))
        bar.outline.set_visible(False)  # type: ignore[operator]
        bar.set_label("error of a joint [cm]", fontsize=10, color=INK)
        axes.tick_params(labelsize=9, color=FAINT, labelcolor=INK)

    def pixels(self) -> np.ndarray:
        """Return the sheet (height, width, 3), uint8."""
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3]


def png(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3), uint8, as PNG."""
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def shorten(name: str, most: int) -> str:
    """Return the end of a name that is longer than `most` characters."""
    return name if len(name) <= most else "…" + name[1 - most :]
