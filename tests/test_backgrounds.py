"""Background folders of every layout, and what is wrong with some."""

from __future__ import annotations

import pickle

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.distractors.backgrounds import load_backgrounds
from dmcvb_gen.errors import BackgroundError


def clip(frames=3, height=40, width=60, seed=0):
    return np.random.default_rng(seed).integers(0, 255, (frames, height, width, 3), np.uint8)


def write_video(path, frames):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        iio.imwrite(path, frames, plugin="FFMPEG", fps=12, macro_block_size=2)
        return
    pictures = [Image.fromarray(frame) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:])


def test_builtin_clips_are_24_frames_and_differ_between_splits():
    train, val = load_backgrounds("builtin", "train"), load_backgrounds("builtin", "val")
    assert len(train) == len(val) == 8
    assert set(train.lengths) == set(val.lengths) == {24}
    assert train.frames(0).shape == (24, 256, 256, 3)
    assert train.digest != val.digest
    first = {train.frames(v)[0].tobytes() for v in range(8)} | {val.frames(v)[0].tobytes() for v in range(8)}
    assert len(first) == 16
    for backgrounds in (train, val):
        for video in range(8):
            frames = backgrounds.frames(video).astype(int)
            assert frames.std() > 15  # busy
            assert np.abs(frames[1:] - frames[:-1]).mean() > 0.5  # and moving


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
@pytest.mark.parametrize("folder", ["validation", "val"])
def test_a_folder_with_splits_keeps_them(tmp_path, suffix, folder):
    write_video(tmp_path / "train" / f"a{suffix}", clip())
    write_video(tmp_path / folder / f"b{suffix}", clip(4))
    assert load_backgrounds(tmp_path, "train").names == ("a",)
    val = load_backgrounds(tmp_path, "val")
    assert val.names == ("b",) and val.lengths == (4,) and val.frames(0).shape == (4, 256, 256, 3)


def test_folders_of_frames_are_videos(tmp_path):
    for name in ("bear", "camel"):
        (tmp_path / name).mkdir()
        for index, frame in enumerate(clip(5)):
            Image.fromarray(frame).save(tmp_path / name / f"{index:05d}.jpg")
    assert load_backgrounds(tmp_path, "train").names == ("bear",)
    assert load_backgrounds(tmp_path, "val").names == ("camel",)
    assert load_backgrounds(tmp_path, "val").lengths == (5,)


def test_loose_files_are_split_by_name_and_pictures_are_videos_of_one_frame(tmp_path):
    for index in range(4):
        Image.fromarray(clip(1, seed=index)[0]).save(tmp_path / f"{index}.png")
    train, val = load_backgrounds(tmp_path, "train"), load_backgrounds(tmp_path, "val")
    assert train.names == ("0", "2") and val.names == ("1", "3") and train.lengths == (1, 1)


def test_the_central_square_is_kept(tmp_path):
    picture = np.zeros((100, 300, 3), np.uint8)
    picture[:, 100:200] = 200
    Image.fromarray(picture).save(tmp_path / "a.png")
    assert (load_backgrounds(tmp_path, "train").frames(0) == 200).all()


def test_backgrounds_travel_to_workers(tmp_path):
    write_video(tmp_path / "a.webp", clip())
    backgrounds = load_backgrounds(tmp_path)
    copy = pickle.loads(pickle.dumps(backgrounds))  # as multiprocessing does
    np.testing.assert_array_equal(copy.frames(0), backgrounds.frames(0))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(BackgroundError, match="does not exist"):
        load_backgrounds(tmp_path / "nowhere")


def test_an_empty_folder_says_what_to_put_in(tmp_path):
    with pytest.raises(BackgroundError, match="holds no videos.*mp4"):
        load_backgrounds(tmp_path)


@pytest.mark.parametrize("name", ["broken.mp4", "broken.webp", "broken.png"])
def test_an_unreadable_file_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"not a video" * 50)
    with pytest.raises(BackgroundError, match=name):
        load_backgrounds(tmp_path)


def test_a_truncated_video_is_named(tmp_path):
    write_video(tmp_path / "a.webp", clip(6, 200, 200))
    data = (tmp_path / "a.webp").read_bytes()
    (tmp_path / "a.webp").write_bytes(data[: len(data) // 2])
    with pytest.raises(BackgroundError, match="a.webp"):
        load_backgrounds(tmp_path)
