"""Moving pictures of episodes: several side by side, with their scores drawn in."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_kfcv.common.evaluation import rounded
from sb3_kfcv.envs.drawing import Scene, draw, without_caption_strip
from sb3_kfcv.matches import Arena
from sb3_kfcv.saving.files import atomic_write

PAUSE = 10  # frames for which the last picture stands still
FASTEST_GIF = 50.0  # frames per second
LONGEST_GIF_FRAME = 65_535  # hundredths of a second

PAPER, INK, BORDER, FADED = (255, 255, 255), (40, 44, 52), (140, 144, 150), 0.45
TITLE_HEIGHT, LINE_HEIGHT, TEXT_HEIGHT, LEAST_TEXT_HEIGHT = 24, 19, 14, 10  # pixels
GAP = 6  # between tiles, in pixels
WIDTH, LARGEST_TILE, SMALLEST_TILE = 720, 480, 160  # of the whole picture if it can be; of a world's picture


@dataclass
class Score:
    """
    How an episode stands.

    :param returns: of each agent so far (agents,)
    :param steps: env steps so far
    :param is_over: whether it has ended
    :param metrics: of an episode that has ended
    """

    returns: np.ndarray
    steps: int = 0
    is_over: bool = False
    metrics: dict[str, float] = field(default_factory=dict)


class Camera:
    """
    Watches the worlds of an arena, each one's first episode after a reset: one picture of all of them after every step, with
    the score of each drawn in. Episodes that have ended stand still, faded, with their final score.

    :param arena: whose worlds are drawn
    :param title: lines over the whole picture
    :param show: what takes the pictures, uint8 (height, width, 3), all of one size
    :param grid: rows and columns; by default as many of each
    """

    def __init__(
        self, arena: Arena, title: Sequence[str], show: Callable[[np.ndarray], Any], grid: tuple[int, int] | None = None
    ) -> None:
        self.arena, self.title, self.show = arena, list(title), show
        self.grid = grid or grid_for(arena.env.num_envs)
        self.tile_width = min(LARGEST_TILE, max(SMALLEST_TILE, WIDTH // self.grid[1])) // 2 * 2
        self._has_scenes = arena.env.has_attr("scene")
        groups = arena.layout.group_names
        self._names = dict(zip(groups, groups if len(groups) > 1 else ["return"], strict=True))
        self._scores: list[Score] = []
        self._tiles: list[Image.Image] = []
        names = self._names.values()
        widest = max(font(LEAST_TEXT_HEIGHT).getlength(f"{name} -000.00") for name in names)
        self._columns = 2 if widest <= self.tile_width / 2 else 1

    def __call__(self, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """Hears of a reset or a step, see :meth:`Arena.play`."""
        n_worlds, n_agents = self.arena.env.num_envs, self.arena.layout.n_agents
        if not infos:
            self._scores = [Score(np.zeros(n_agents)) for _ in range(n_worlds)]
        running = [i for i, score in enumerate(self._scores) if not score.is_over]
        for i in running if infos else ():
            score = self._scores[i]
            score.returns, score.steps, score.is_over = (
                score.returns + infos[i]["agent_rewards"],
                score.steps + 1,
                bool(dones[i]),
            )
            if score.is_over:
                score.metrics = infos[i]["episode_metrics"]
        pictures = [] if self._has_scenes else self.arena.env.get_images()
        tiles = dict(zip(range(n_worlds), self._tiles, strict=False))
        for i in running:
            info = infos[i] if infos else {}
            if self._has_scenes:
                tiles[i] = self._of_scene(info.get("terminal_scene") or self._scene(i), self._scores[i])
            else:
                tiles[i] = self._of_picture(info.get("terminal_picture", pictures[i]), self._scores[i])
        self._tiles = [tiles[i] for i in range(n_worlds)]
        self.show(self._composed())

    def _scene(self, world: int) -> Scene:
        return self.arena.env.env_method("scene", indices=[world])[0]

    def _of_scene(self, scene: Scene, score: Score) -> Image.Image:
        picture = without_caption_strip(draw(replace(scene, caption=""), self.tile_width))
        return self._tile(Image.fromarray(picture), scene.caption.split("  "), score)

    def _of_picture(self, picture: np.ndarray | None, score: Score) -> Image.Image:
        if picture is None:
            raise ValueError("the world draws no pictures")
        image = Image.fromarray(picture)
        height = round(image.height * self.tile_width / image.width)
        image = image.resize((self.tile_width, height), Image.Resampling.BOX)
        ImageDraw.Draw(image).rectangle((0, 0, image.width - 1, height - 1), outline=BORDER)
        return self._tile(image, [f"step {score.steps}"], score)

    def _tile(self, picture: Image.Image, parts: Sequence[str], score: Score) -> Image.Image:
        """
        :param picture: of the world
        :param parts: what is told of it beside the score
        :param score: of the episode
        """
        returns: Mapping[str, Any] = self.arena.layout.group_means(score.returns)
        if score.is_over:
            returns = {group: score.metrics[f"return_{group}"] for group in returns}
            picture = Image.blend(Image.new("RGB", picture.size, PAPER), picture, FADED)
        verdict = self._verdict(score.metrics) if score.is_over else ""
        cells = [*parts, *(f"{self._names[group]} {rounded(value):+.2f}" for group, value in returns.items()), verdict]
        top, cell_width = math.ceil(len(cells) / self._columns) * LINE_HEIGHT, self.tile_width // self._columns
        tile = Image.new("RGB", (self.tile_width, top + picture.height), PAPER)
        tile.paste(picture, (0, top))
        pen = ImageDraw.Draw(tile)
        for i, cell in enumerate(cells):
            line, column = divmod(i, self._columns)
            place = (2 + column * cell_width, round((line + 0.5) * LINE_HEIGHT))
            write(pen, cell, place, cell_width - 4, TEXT_HEIGHT)
        return tile

    def _verdict(self, metrics: dict[str, float]) -> str:
        """Who has won, where the world says so."""
        shares = {group: metrics[name] for group, name in self.arena.wins.items()}
        if len(shares) == 1 and len(self.arena.layout.group_names) == 2:
            (winner,) = shares
            shares.update((group, 1 - shares[winner]) for group in self.arena.layout.group_names if group != winner)
        for group, share in shares.items():
            if share > 0.5:
                return f"{group} wins"
        return "over"

    def _composed(self) -> np.ndarray:
        """All tiles in their grid, under the title; both sides even, as video needs them."""
        rows, columns = self.grid
        tile_height = self._tiles[0].height
        top = TITLE_HEIGHT * len(self.title)
        width, height = (self.tile_width + GAP) * columns + GAP, (tile_height + GAP) * rows + top
        picture = Image.new("RGB", (width + width % 2, height + height % 2), PAPER)
        pen = ImageDraw.Draw(picture)
        for i, line in enumerate(self.title):
            write(pen, line, (GAP, round((i + 0.5) * TITLE_HEIGHT)), width - 2 * GAP, TEXT_HEIGHT + (2 if i == 0 else 0))
        for i, tile in enumerate(self._tiles):
            row, column = divmod(i, columns)
            picture.paste(tile, (GAP + column * (self.tile_width + GAP), top + row * (tile_height + GAP)))
        return np.asarray(picture)


def grid_for(n: int) -> tuple[int, int]:
    """Rows and columns for so many tiles: up to three in a row, else as square as can be, rather wide than high."""
    columns = n if n <= 3 else math.ceil(math.sqrt(n))
    return math.ceil(n / columns), columns


def write(pen: ImageDraw.ImageDraw, text: str, place: tuple[int, int], width: int, height: int) -> None:
    """
    Write a line, smaller where it would not fit.

    :param pen: of the picture
    :param text: the line
    :param place: left end and middle, in pixels
    :param width: that there is, in pixels
    :param height: of the letters, in pixels
    """
    while height > LEAST_TEXT_HEIGHT and font(height).getlength(text) > width:
        height -= 1
    pen.text(place, text, fill=INK, anchor="lm", font=font(height))


def font(height: int) -> ImageFont.FreeTypeFont:
    """The font of a height in pixels."""
    return ImageFont.load_default(height)  # type: ignore[return-value]


def film(
    arena: Arena,
    players: dict[str, Any],
    title: Sequence[str],
    seed: int = 0,
    grid: tuple[int, int] | None = None,
    deterministic: bool = True,
) -> tuple[list[np.ndarray], Any]:
    """
    Pictures of one episode of each world of an arena, side by side.

    :param arena: with worlds that are drawn
    :param players: as :meth:`Arena.play` takes them
    :param title: lines over the picture
    :param seed: of the first episode
    :param grid: rows and columns
    :param deterministic: greedily
    :return: frames, uint8 (height, width, 3), the last one for a while; and the episodes
    """
    frames: list[np.ndarray] = []
    camera = Camera(arena, title, frames.append, grid)
    episodes = arena.play(players, arena.env.num_envs, seed, deterministic, camera)
    return frames + frames[-1:] * PAUSE, episodes


def gif_fps(fps: float) -> float:
    """
    The frames per second of a GIF, which stores how long each stands in hundredths of a second; viewers slow down what stands
    shorter than two of them.

    :param fps: what is wished for
    :return: the nearest that there is
    """
    return 100 / round(min(max(100 / fps, 100 / FASTEST_GIF), LONGEST_GIF_FRAME))


def save_gif(frames: Sequence[np.ndarray], path: str | Path, fps: float) -> None:
    """
    Write frames as an endless GIF.

    :param frames: uint8 (height, width, 3)
    :param path: of the file
    :param fps: frames per second, as near as :func:`gif_fps` can come
    """
    # One palette for all frames: flat colours stay the same from frame to frame, and the file small.
    palette = Image.fromarray(np.concatenate(list(frames[:: max(1, len(frames) // 8)]))).quantize(128)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = round(1000 / gif_fps(fps))  # milliseconds
    with atomic_write(path) as file:
        images[0].save(file, format="GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)


def save_mp4(frames: Sequence[np.ndarray], path: str | Path, fps: float) -> None:
    """
    Write frames as MP4 (H.264), which every browser plays.

    :param frames: uint8 (height, width, 3), both even
    :param path: of the file
    :param fps: frames per second
    :raises ValueError: if moviepy is missing
    """
    clip = require_moviepy().ImageSequenceClip(list(frames), fps=fps)
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "film.mp4"
        clip.write_videofile(str(written), codec="libx264", audio=False, logger=None, pixel_format="yuv420p")
        with atomic_write(path) as file:
            file.write(written.read_bytes())


def require_moviepy() -> Any:
    """
    The package that writes MP4.

    :raises ValueError: if it is missing, with the command that installs it
    """
    try:
        import moviepy
    except ImportError:
        raise ValueError('MP4 needs moviepy: pip install "sb3-kfcv[video]" (a GIF needs nothing more)') from None
    return moviepy
