"""Background folders of every layout, and what is wrong with some."""

from __future__ import annotations

import os
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
    if path.suffix in (".gif", ".webp"):
        pictures = [Image.fromarray(frame) for frame in frames]
        pictures[0].save(path, save_all=True, append_images=pictures[1:])
    else:  # with its index in front, where a format can have it, so that the beginning still opens
        options = ["-movflags", "faststart"] if path.suffix == ".mp4" else []
        iio.imwrite(path, frames, plugin="FFMPEG", fps=12, macro_block_size=2, quality=10, output_params=options)


def write_frames(folder, frames, kind="jpg"):
    folder.mkdir(parents=True, exist_ok=True)
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


STILLS = {f"{index}": 1 for index in range(5)}


@pytest.mark.parametrize(
    ("files", "train", "val"),
    [
        ({"train/a.gif": 3, "val/b.webp": 4}, {"a": 3}, {"b": 4}),
        ({"train/a.mp4": 3, "validation/b.mp4": 4}, {"a": 3}, {"b": 4}),
        ({"train/": 5, "test/b.gif": 4}, STILLS, {"b": 4}),
        ({"bear/": 5, "camel/": 5}, {"bear": 5}, {"camel": 5}),
        ({"": 5}, {"0": 1, "2": 1, "4": 1}, {"1": 1, "3": 1}),
        ({"bear/": 5, "train/": 5, "walking/": 5}, {"bear": 5, "walking": 5}, {"train": 5}),
    ],
)
def test_folders_of_every_layout_are_split_in_two(files, train, val, tmp_path):
    """A name that ends with a slash is a folder of images."""
    for name, frames in files.items():
        write = write_video if Path(name).suffix else write_frames
        write(tmp_path / name, clip(frames))
    for split, expected in (("train", train), ("val", val)):
        found = load_backgrounds(tmp_path, split)
        assert dict(zip(found.names, found.lengths, strict=True)) == expected
        assert found.frames(0).shape[1:] == (256, 256, 3)
    separate = any(name.startswith(("val", "test")) for name in files)
    assert videos_by_split(tmp_path) == (None if separate else {"train": len(train), "val": len(val)})


def test_the_central_square_is_kept(tmp_path):
    picture = np.zeros((100, 300, 3), np.uint8)
    picture[:, 100:200] = 200
    Image.fromarray(picture).save(tmp_path / "a.png")
    assert (load_backgrounds(tmp_path, "train").frames(0) == 200).all()


def test_what_is_no_folder_of_videos_of_a_split_is_named(tmp_path):
    write_video(tmp_path / "train" / "a.webp", clip())
    (tmp_path / "empty").mkdir()
    for name, split, message in (
        ("nowhere", "train", "are no folder; give a folder of videos"),
        ("empty", "train", "holds no videos.*mp4"),
        ("", "val", "no val or validation"),
    ):
        with pytest.raises(BackgroundError, match=message):
            load_backgrounds(tmp_path / name, split)


@pytest.mark.parametrize("suffix", [".png", ".mp4"])
def test_a_file_of_more_pixels_than_anybody_films_is_not_decoded(tmp_path, monkeypatch, suffix):
    iio.imwrite(tmp_path / f"a{suffix}", clip(1, 128, 128)[0 if suffix == ".png" else slice(None)])
    monkeypatch.setattr(backgrounds_module, "MAX_PIXELS", 127 * 128)
    with pytest.raises(BackgroundError, match="16,256 pixels|size 128x128"):
        load_backgrounds(tmp_path)


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv", ".gif", ".webp", ".png", ".jpg"])
@pytest.mark.parametrize("share", [0.5, 0.9, None])
def test_a_truncated_or_unreadable_file_is_named_instead_of_giving_fewer_frames(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    frames = clip(12, 128, 128)
    if suffix in (".png", ".jpg"):
        Image.fromarray(frames[0]).save(path)
    else:
        write_video(path, frames)
    assert load_backgrounds(tmp_path).lengths == (1 if suffix in (".png", ".jpg") else 12,)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)] if share else b"not a video" * 50)
    with pytest.raises(BackgroundError, match=path.name):
        load_backgrounds(tmp_path)


def test_a_video_keeps_its_colors_order_and_central_square(tmp_path):
    frames = np.zeros((5, 64, 128, 3), np.uint8)
    frames[:, :, 32:96] = [[[[40 * k, 200 - 40 * k, 90]]] for k in range(5)]
    write_video(tmp_path / "a.mp4", frames)
    found = load_backgrounds(tmp_path).frames(0)
    assert found.shape == (5, 256, 256, 3)
    for index in range(5):
        np.testing.assert_allclose(found[index].mean((0, 1)), [40 * index, 200 - 40 * index, 90], atol=6)


def test_a_picture_is_one_frame_even_if_its_file_holds_more(tmp_path):
    pictures = [Image.fromarray(frame) for frame in clip(3)]
    pictures[0].save(tmp_path / "photo.jpg", "MPO", save_all=True, append_images=pictures[1:])
    pictures[0].save(tmp_path / "zoom.png", save_all=True, append_images=pictures[1:])
    assert [load_backgrounds(tmp_path, split).lengths for split in ("train", "val")] == [(1,), (1,)]


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
    assert load_backgrounds(tmp_path) is first and not first.frames(0).flags.writeable  # callers share the frames
    write_video(tmp_path / "a.webp", clip(4, seed=1))
    assert load_backgrounds(tmp_path).lengths == (4,) and load_backgrounds(tmp_path).digest != first.digest


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


def test_images_of_sixteen_bits_keep_their_brightness(tmp_path):
    ramp = np.linspace(0, 65535, 256).astype(np.uint16)
    Image.fromarray(np.tile(ramp, (256, 1))).save(tmp_path / "ramp.png")
    frame = load_backgrounds(tmp_path).frames(0)[0].astype(int)
    assert np.abs(frame - np.arange(256)[None, :, None]).max() <= 1


def test_photos_are_turned_as_they_say(tmp_path):
    picture = Image.fromarray(np.repeat(np.uint8([[[0], [255]]]), 3, axis=2).repeat(64, 0).repeat(32, 1))
    turned = picture.getexif()
    turned[0x0112] = 6
    picture.save(tmp_path / "a.tif", exif=turned)
    frame = load_backgrounds(tmp_path).frames(0)[0].astype(int)
    assert frame[:100].mean() < 10 and frame[-100:].mean() > 245


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
