"""The preview: a video large enough to see, rows of a maze's sheet with names, one grid for any number of views."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.preview import LABEL_HEIGHT, VIDEO_SIDE, episode_strip, video_frames, write_preview


@pytest.mark.parametrize("release", ["small_release", "maze_release"])
def test_the_video_has_some_512_pixels_a_side_and_shows_the_stored_frames(release, request):
    subset = next(iter(Release.open(request.getfixturevalue(release)).subsets.values()))
    video = video_frames([subset], frames=2)
    assert len(video) == 2 and VIDEO_SIDE <= min(video.shape[1:3]) < 2 * VIDEO_SIDE
    array = subset.pixel_arrays[0] if release == "small_release" else "pixels/top"
    stored = subset.episode(int(subset.episodes[0]), [array])[array][1]
    columns = 1 if release == "small_release" else 3  # four views: three in a row
    scale = video.shape[2] // (columns * stored.shape[1])
    first = video[1, 3 * LABEL_HEIGHT :, : stored.shape[1] * scale][: stored.shape[0] * scale]
    np.testing.assert_array_equal(first[::scale, ::scale], stored)
    place, earned = video[:, LABEL_HEIGHT : 2 * LABEL_HEIGHT], video[:, 2 * LABEL_HEIGHT : 3 * LABEL_HEIGHT]
    assert (place[0] != place[1]).any() and place.min() < 60 and earned.min() < 60  # the step, the return so far


@pytest.mark.slow
def test_a_sheet_of_many_subsets_fits_on_a_screen(small_release, tmp_path):
    sheet, _ = write_preview(small_release, out=tmp_path)
    assert len(Release.open(small_release).subsets) == 3 and Image.open(sheet).height == 6 * (LABEL_HEIGHT + 32)


def test_each_row_of_a_maze_has_a_label_above_it(maze_release, small_release):
    maze = next(iter(Release.open(maze_release).subsets.values()))
    walker = next(iter(Release.open(small_release).subsets.values()))
    rows = len(maze.record.views)
    strip = episode_strip(maze, 0, columns=20, scale=2)
    assert strip.shape[0] == LABEL_HEIGHT + rows * (LABEL_HEIGHT + 32)
    for row in range(rows):
        label = strip[LABEL_HEIGHT + row * (LABEL_HEIGHT + 32) :][:LABEL_HEIGHT]
        assert label.min() < 60 and (label == 255).mean() > 0.8, row  # dark text on white
    assert episode_strip(walker, 0, columns=20, scale=2).shape[0] == LABEL_HEIGHT + 32


def test_a_preview_is_written_through_no_link(copy, tmp_path):
    (copy / "preview").mkdir(exist_ok=True)
    (tmp_path / "victim").write_text("mine")
    (copy / "preview/contact_sheet.png").unlink(missing_ok=True)
    (copy / "preview/contact_sheet.png").symlink_to(tmp_path / "victim")
    with pytest.raises(StoreError, match="is a link"):
        write_preview(copy)
    assert (tmp_path / "victim").read_text() == "mine"
