"""Background folders of every layout, and what is wrong with some."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.distractors import backgrounds as backgrounds_module
from dmcvb_gen.distractors.backgrounds import load_backgrounds, videos_by_split
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


def write_frames(folder, frames, kind="jpg"):
    folder.mkdir(exist_ok=True)
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{index}.{kind}")


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
        write_frames(tmp_path / name, clip(5))
    assert load_backgrounds(tmp_path, "train").names == ("bear",)
    assert load_backgrounds(tmp_path, "val").names == ("camel",)
    assert load_backgrounds(tmp_path, "val").lengths == (5,)


def test_loose_files_are_split_by_name_and_pictures_are_videos_of_one_frame(tmp_path):
    write_frames(tmp_path, clip(4), "png")
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


def test_what_is_no_folder_of_videos_of_a_split_is_named(tmp_path):
    write_video(tmp_path / "train" / "a.webp", clip())
    (tmp_path / "empty").mkdir()
    for name, split, message in (
        ("nowhere", "train", "does not exist"),
        ("empty", "train", "holds no videos.*mp4"),
        ("", "val", "no val or validation"),
        ("", "test", "unknown split"),
        ("train/a.webp", "train", "is a file; give the folder"),
    ):
        with pytest.raises(BackgroundError, match=message):
            load_backgrounds(tmp_path / name, split)


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv", ".gif", ".webp", ".png", ".jpg"])
@pytest.mark.parametrize("share", [0.5, 0.9, None])
def test_a_truncated_or_unreadable_file_is_named_instead_of_giving_fewer_frames(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    frames = clip(12, 128, 128)
    if suffix in (".png", ".jpg"):
        Image.fromarray(frames[0]).save(path)
    elif suffix in (".gif", ".webp"):
        write_video(path, frames)
    else:  # with its index in front, where a format can have it, so that the beginning still opens
        options = ["-movflags", "faststart"] if suffix == ".mp4" else []
        iio.imwrite(path, frames, plugin="FFMPEG", fps=12, macro_block_size=2, output_params=options)
    assert load_backgrounds(tmp_path).lengths == (1 if suffix in (".png", ".jpg") else 12,)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)] if share else b"not a video" * 50)
    with pytest.raises(BackgroundError, match=path.name):
        load_backgrounds(tmp_path)


def test_a_video_keeps_its_colors_order_and_central_square(tmp_path):
    frames = np.zeros((5, 64, 128, 3), np.uint8)
    frames[:, :, 32:96] = [[[[40 * k, 200 - 40 * k, 90]]] for k in range(5)]
    iio.imwrite(tmp_path / "a.mp4", frames, plugin="FFMPEG", fps=12, macro_block_size=2, quality=10)
    found = load_backgrounds(tmp_path).frames(0)
    assert found.shape == (5, 256, 256, 3)
    for index in range(5):
        np.testing.assert_allclose(found[index].mean((0, 1)), [40 * index, 200 - 40 * index, 90], atol=6)


def test_numbers_in_names_are_ordered_by_value_and_hidden_files_passed_over(tmp_path):
    write_frames(tmp_path / "walk", [np.full((20, 20, 3), 20 * index, np.uint8) for index in range(12)], "png")
    (tmp_path / "walk" / "._0.png").write_bytes(b"left by another system")
    (tmp_path / ".cache").mkdir()
    found = load_backgrounds(tmp_path)
    assert found.names == ("walk",)
    np.testing.assert_array_equal(found.frames(0)[:, 0, 0, 0], 20 * np.arange(12))


def test_a_changed_file_is_noticed_and_an_unchanged_one_not_read_again(tmp_path):
    write_video(tmp_path / "a.webp", clip(3))
    first = load_backgrounds(tmp_path)
    assert load_backgrounds(tmp_path) is first
    write_video(tmp_path / "a.webp", clip(4, seed=1))
    assert load_backgrounds(tmp_path).lengths == (4,) and load_backgrounds(tmp_path).digest != first.digest


def test_only_the_videos_in_play_are_opened_when_asked_for(tmp_path):
    for index in range(3):
        write_video(tmp_path / "train" / f"{index}.webp", clip(3, seed=index))
    (tmp_path / "train" / "9.webp").write_bytes(b"broken")
    assert load_backgrounds(tmp_path, videos=3).names == ("0", "1", "2")
    with pytest.raises(BackgroundError, match="9.webp"):
        load_backgrounds(tmp_path)


def test_long_videos_count_with_their_first_frames_and_memory_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(backgrounds_module, "MAX_FRAMES", 6)
    monkeypatch.setattr(backgrounds_module, "CACHE_BYTES", 10 * 256 * 256 * 3)
    write_video(tmp_path / "train" / "a.mp4", clip(9))
    write_video(tmp_path / "train" / "b.gif", clip(9))
    write_frames(tmp_path / "train" / "c", clip(9))
    found = load_backgrounds(tmp_path)
    assert found.lengths == (6, 6, 6)
    for video in (0, 1, 2, 0):
        assert len(found.frames(video)) == 6
        assert sum(frames.nbytes for frames in found._decoded.values()) <= 10 * 256 * 256 * 3


def test_decoded_frames_and_their_digest_are_the_same_each_time():
    first = load_backgrounds("builtin", "val")
    again = backgrounds_module.Backgrounds("builtin", "val", list(zip(first.names, first.files, strict=True)))
    assert again.digest == first.digest and again is not first
    assert not first.frames(0).flags.writeable  # nobody changes what others see


def test_a_video_that_is_named_like_a_split_is_a_video(tmp_path):
    for name in ("bear", "train", "walking"):
        write_frames(tmp_path / name, clip(5))
    assert load_backgrounds(tmp_path, "train").names == ("bear", "walking")
    assert load_backgrounds(tmp_path, "val").names == ("train",) and load_backgrounds(tmp_path).lengths == (5, 5)
    assert videos_by_split(tmp_path) == {"train": 2, "val": 1}
    for name in ("bear", "walking"):
        shutil.rmtree(tmp_path / name)
    assert load_backgrounds(tmp_path, "train").lengths == (1,) * 5  # with nothing beside it, it is the split


def test_images_of_sixteen_bits_keep_their_brightness(tmp_path):
    ramp = np.linspace(0, 65535, 256).astype(np.uint16)
    Image.fromarray(np.tile(ramp, (256, 1))).save(tmp_path / "ramp.png")
    frame = load_backgrounds(tmp_path).frames(0)[0].astype(int)
    assert np.abs(frame - np.arange(256)[None, :, None]).max() <= 1


def test_a_missing_decoder_says_what_to_install(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4", clip())
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match="imageio_ffmpeg"):
        load_backgrounds(tmp_path)


@pytest.mark.full
def test_a_made_clip_is_a_video(tmp_path):
    pytest.importorskip("mujoco.egl")
    script = Path(__file__).parents[2] / "scripts" / "make_clips.py"
    command = [sys.executable, str(script), "--videos", "1", "--seed", "5", "--out", str(tmp_path)]
    subprocess.run(command, check=True, env=os.environ | {"MUJOCO_GL": "egl"})
    frames = load_backgrounds(tmp_path, "train").frames(0).astype(int)
    assert frames.shape == (24, 256, 256, 3) and frames.std() > 15 and np.abs(np.diff(frames, axis=0)).mean() > 0.5
