"""Pictures: what is drawn, in which colour, and where."""

import numpy as np
import pytest
from PIL import Image

from sb3_kfcv.envs.drawing import PALETTE, Disc, Rectangle, Scene, draw, pixel_of, save_gif, without_caption_strip

SIZE = 300


def colour_at(scene: Scene, x: float, y: float) -> tuple[int, ...]:
    row, column = pixel_of(scene, x, y, SIZE)
    return tuple(int(value) for value in draw(scene, SIZE)[row, column])


def test_picture_is_a_square_of_uint8():
    picture = draw(Scene(1.0, []), SIZE)
    assert picture.shape == (SIZE, SIZE, 3)
    assert picture.dtype == np.uint8


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-0.8, 0.8), (0.8, 0.8), (0.8, -0.8)])
def test_disc_has_its_colour_at_its_place(x, y):
    scene = Scene(1.0, [Disc(x, y, 0.1, PALETTE["wolf"])])
    assert colour_at(scene, x, y) == PALETTE["wolf"]
    assert colour_at(scene, x + 0.15, y) == PALETTE["background"]
    assert colour_at(scene, x, y + 0.15) == PALETTE["background"]


def test_y_points_up():
    upper, lower = (pixel_of(Scene(1.0, []), 0.0, y, SIZE)[0] for y in (0.5, -0.5))
    assert upper < lower


def test_the_radius_is_to_scale():
    scene = Scene(2.0, [Disc(0.0, 0.0, 1.0, PALETTE["sheep"])])
    picture = draw(scene, SIZE)
    row, left = pixel_of(scene, -1.0, 0.0, SIZE)
    _, right = pixel_of(scene, 1.0, 0.0, SIZE)
    blue = np.flatnonzero((picture[row] == PALETTE["sheep"]).all(axis=-1))
    assert blue.min() == pytest.approx(left, abs=3)
    assert blue.max() == pytest.approx(right, abs=3)


def test_wall_with_a_door():
    wall = PALETTE["wall"]
    scene = Scene(3.0, [], [Rectangle(-0.2, -3, 0.2, 0.8, wall), Rectangle(-0.2, 1.2, 0.2, 3, wall)])
    assert colour_at(scene, 0.0, 0.5) == wall
    assert colour_at(scene, 0.0, 1.5) == wall
    assert colour_at(scene, 0.0, 1.0) == PALETTE["background"]
    assert colour_at(scene, 0.4, 0.5) == PALETTE["background"]


def test_what_lies_outside_the_plane_is_cut_off():
    inside = Scene(1.0, [], [Rectangle(0.5, -1, 1, 1, PALETTE["wall"])])
    beyond = Scene(1.0, [], [Rectangle(0.5, -9, 9, 9, PALETTE["wall"])])
    np.testing.assert_array_equal(draw(inside, SIZE), draw(beyond, SIZE))


def test_a_faded_disc_is_lighter():
    solid = colour_at(Scene(1.0, [Disc(0, 0, 0.2, PALETTE["sheep"])]), 0, 0)
    faded = colour_at(Scene(1.0, [Disc(0, 0, 0.2, PALETTE["sheep"], opacity=0.3)]), 0, 0)
    assert all(light > dark for light, dark in zip(faded, solid, strict=True))
    assert faded != PALETTE["background"]


def test_a_faded_disc_lies_under_a_solid_one():
    solid = Disc(0, 0, 0.2, PALETTE["wolf"])
    faded = Disc(0, 0, 0.2, PALETTE["sheep"], opacity=0.3)
    assert colour_at(Scene(1.0, [solid, faded]), 0, 0) == PALETTE["wolf"]


def test_the_border_is_seen():
    picture = draw(Scene(1.0, []), SIZE)
    for x, y in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]:
        row, column = pixel_of(Scene(1.0, []), x, y, SIZE)
        assert picture[row - 1 : row + 2, column - 1 : column + 2].min() < 150


def test_the_caption_is_above_the_plane_only():
    plain, titled = (draw(Scene(1.0, [], caption=caption), SIZE) for caption in ("", "step 12/25"))
    top = pixel_of(Scene(1.0, []), 0.0, 1.0, SIZE)[0]
    assert (plain[:top] != titled[:top]).any()
    np.testing.assert_array_equal(plain[top:], titled[top:])


def test_a_label_is_written_on_its_disc():
    plain, labelled = (draw(Scene(1.0, [Disc(0, 0, 0.3, PALETTE["agent"], label=label)]), SIZE) for label in (None, "7"))
    assert labelled.max() == 255
    assert (plain != labelled).any()


def test_gif_keeps_frames_and_rate(tmp_path):
    frames = [draw(Scene(1.0, [Disc(x, 0, 0.2, PALETTE["wolf"])]), 80) for x in (-0.5, 0.0, 0.5)]
    save_gif(frames, tmp_path / "run.gif", fps=5)
    with Image.open(tmp_path / "run.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"]) == (3, (80, 80), 200)


def test_gif_refuses_nothing_and_no_speed(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        save_gif([], tmp_path / "run.gif")
    with pytest.raises(ValueError, match="fps must be positive"):
        save_gif([draw(Scene(1.0, []), 80)], tmp_path / "run.gif", fps=0)


def test_the_plane_without_the_caption_above_it():
    picture = without_caption_strip(draw(Scene(1.0, []), SIZE))
    not_paper = (picture < 255).any(axis=-1)
    rows, columns = np.flatnonzero(not_paper.any(axis=1)), np.flatnonzero(not_paper.any(axis=0))
    above, below = rows[0], len(picture) - 1 - rows[-1]
    assert above == pytest.approx(below, abs=1)
    assert len(rows) == pytest.approx(len(columns), abs=1)
