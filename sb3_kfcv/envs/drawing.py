"""Pictures of the worlds, drawn with Pillow into plain arrays: no display, no graphics driver."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

# Wolves red, sheep blue, grass green, as in figure 7 of the paper. The three shades also differ in lightness,
# so that they stay apart for readers who do not tell red from green.
PALETTE: dict[str, Colour] = {
    "wolf": (204, 51, 17),
    "sheep": (0, 119, 187),
    "grass": (92, 190, 110),
    "agent": (84, 78, 196),
    "landmark": (238, 153, 17),
    "wall": (140, 144, 150),
    "obstacle": (110, 114, 120),
    "background": (250, 250, 247),
}
_PAPER: Colour = (255, 255, 255)
_INK: Colour = (40, 44, 52)

_SUPERSAMPLING = 2
_MARGIN = 0.035  # around the plane, as a share of the picture's side: room for bodies that stand on the border
_CAPTION_HEIGHT = 0.06  # likewise


@dataclass(frozen=True)
class Disc:
    """
    A round body.

    :param x: centre, in world units
    :param y: centre, in world units
    :param radius: in world units
    :param colour: RGB, each 0 to 255
    :param opacity: from 0 (invisible) to 1 (solid); a faded disc lies under the solid ones
    :param label: short text written on the disc
    """

    x: float
    y: float
    radius: float
    colour: Colour
    opacity: float = 1.0
    label: str | None = None


@dataclass(frozen=True)
class Rectangle:
    """
    A wall: the corners (x0, y0) and (x1, y1) in world units, in any order. What lies outside the plane is cut off.

    :param colour: RGB, each 0 to 255
    """

    x0: float
    y0: float
    x1: float
    y1: float
    colour: Colour


@dataclass(frozen=True)
class Scene:
    """
    Everything that one picture shows.

    :param half_width: the plane is [-half_width, half_width]², with y pointing up
    :param discs: drawn over the rectangles; of two solid ones, the later lies on top
    :param rectangles: the walls
    :param caption: one line above the plane, such as ``"step 12/25  eaten 3/12"``
    """

    half_width: float
    discs: Sequence[Disc]
    rectangles: Sequence[Rectangle] = ()
    caption: str = ""


def draw(scene: Scene, size: int = 600) -> np.ndarray:
    """
    Draw a scene: a caption strip at the top and the bordered plane below it.

    :param scene: what to show
    :param size: side of the picture in pixels
    :return: uint8 RGB array (size, size, 3)
    """
    view = _View(scene.half_width, size * _SUPERSAMPLING)
    image = Image.new("RGB", (view.size, view.size), _PAPER)
    pen = ImageDraw.Draw(image, "RGBA")  # blends what it draws by the colour's fourth value
    corners = view.box(-scene.half_width, -scene.half_width, scene.half_width, scene.half_width)

    pen.rectangle(corners, fill=PALETTE["background"])
    for rectangle in scene.rectangles:
        _draw_rectangle(pen, view, rectangle)
    pen.rectangle(corners, outline=_INK, width=_line_width(view.size))
    for disc in sorted(scene.discs, key=lambda disc: disc.opacity):
        _draw_disc(pen, view, disc)
    if scene.caption:
        middle = (view.left, view.top - view.size * _CAPTION_HEIGHT / 2)
        pen.text(middle, scene.caption, fill=_INK, anchor="lm", font=_font(0.6 * view.size * _CAPTION_HEIGHT))

    return np.asarray(image.resize((size, size), Image.Resampling.BOX))


def without_caption_strip(picture: np.ndarray) -> np.ndarray:
    """
    A picture of a scene that has no caption, without the room for one: the plane with even margins.

    :param picture: as :func:`draw` gives it (size, size, 3)
    """
    return picture[round(len(picture) * _CAPTION_HEIGHT) :]


def pixel_of(scene: Scene, x: float, y: float, size: int = 600) -> tuple[int, int]:
    """
    Where a point of the world lies in the picture that :func:`draw` makes.

    :param scene: the scene drawn
    :param x: in world units
    :param y: in world units
    :param size: side of the picture in pixels
    :return: row and column of the pixel
    """
    view = _View(scene.half_width, size)
    column, row = view.point(x, y)
    return int(row), int(column)


def save_gif(frames: Sequence[np.ndarray], path: str | os.PathLike[str], fps: float = 10) -> None:
    """
    Write pictures as an animation that repeats for ever.

    :param frames: uint8 RGB arrays (height, width, 3), all of one size
    :param path: file to write
    :param fps: pictures per second
    :raises ValueError: if there is no picture or the rate is not positive
    """
    if len(frames) == 0:
        raise ValueError(f"an animation needs at least one frame; none was given for {os.fspath(path)!r}")
    if fps <= 0:
        raise ValueError(f"fps must be positive; got {fps}")
    first, *others = [Image.fromarray(frame) for frame in frames]
    first.save(path, format="GIF", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


class _View:
    """
    From world units to pixels.

    :param half_width: of the plane, in world units
    :param size: side of the picture in pixels
    """

    def __init__(self, half_width: float, size: int) -> None:
        self.half_width = half_width
        self.size = size
        side = size * (1 - _CAPTION_HEIGHT - 2 * _MARGIN)
        self.scale = side / (2 * half_width)
        self.left = (size - side) / 2
        self.top = size * (_CAPTION_HEIGHT + _MARGIN)

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Column and row of a point."""
        return self.left + (x + self.half_width) * self.scale, self.top + (self.half_width - y) * self.scale

    def box(self, x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
        """Upper left and lower right corner of an upright box, cut off at the plane's border."""
        x0, x1 = np.clip(sorted((x0, x1)), -self.half_width, self.half_width)
        y0, y1 = np.clip(sorted((y0, y1)), -self.half_width, self.half_width)
        return [self.point(x0, y1), self.point(x1, y0)]


def _draw_rectangle(pen: ImageDraw.ImageDraw, view: _View, rectangle: Rectangle) -> None:
    corners = view.box(rectangle.x0, rectangle.y0, rectangle.x1, rectangle.y1)
    pen.rectangle(corners, fill=rectangle.colour)


def _draw_disc(pen: ImageDraw.ImageDraw, view: _View, disc: Disc) -> None:
    column, row = view.point(disc.x, disc.y)
    radius = disc.radius * view.scale
    bounds = [(column - radius, row - radius), (column + radius, row + radius)]
    alpha = round(255 * disc.opacity)
    rim = tuple(round(0.65 * value) for value in disc.colour)
    pen.ellipse(bounds, fill=(*disc.colour, alpha), outline=(*rim, alpha), width=_line_width(view.size))
    if disc.label:
        pen.text((column, row), disc.label, fill=(*_PAPER, alpha), anchor="mm", font=_font(1.2 * radius))


def _line_width(size: int) -> int:
    return max(1, round(size / 400))


@lru_cache(maxsize=16)
def _font_of_height(height: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(height)


def _font(height: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return _font_of_height(max(8, round(height)))
