"""Distractors: ranges, statistics, independence."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import ks_2samp, kstest

from dmcvb_gen.distractors import Distractor, DistractorSampler, DistractorSetting, load_backgrounds, sample_distractors
from dmcvb_gen.distractors.background import ping_pong
from dmcvb_gen.distractors.camera import CameraRange, camera_range, camera_walk, spherical
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.own_code import DISTRACTORS
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task
from dmcvb_gen.tasks.base import PHYSICS_SPEC
from dmcvb_gen.tasks.cameras import camera_ids, centers_of_mass, matrices, nominal_cameras
from dmcvb_gen.tasks.locomotion import WalkerWalk
from tests.conftest import posed


def physics_of(task, episodes=2, frames=41):
    batch = task.batch(episodes)
    batch.reset([np.random.default_rng(i) for i in range(episodes)])
    rng, rows = np.random.default_rng(9), [batch.physics()]
    for _ in range(frames - 1):
        batch.step(rng.uniform(-1, 1, (episodes, task.action_size)))
        rows.append(batch.physics())
    return np.stack(rows, axis=1)


def generators(episodes, seed=0):
    return {name: [episode_stream(seed, ("test",), i, name) for i in episodes] for name in STREAMS}


def labels(task, setting, physics, episodes=None, seed=0):
    episodes = range(len(physics)) if episodes is None else episodes
    backgrounds = load_backgrounds("builtin", "train")
    return sample_distractors(task, DistractorSetting.parse(setting), physics, generators(episodes, seed), backgrounds)


@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_none_is_the_models_own_look(task_id):
    task = get_task(task_id)
    physics = physics_of(task, frames=5)
    found = labels(task, "none", physics)
    position, quaternion = nominal_cameras(task, physics.reshape(-1, physics.shape[-1]))
    np.testing.assert_array_equal(found.camera_position.reshape(-1, 1, 3), position)
    np.testing.assert_array_equal(found.camera_quaternion.reshape(-1, 1, 4), quaternion)
    assert (found.background_video == -1).all() and (found.style == -1).all()
    np.testing.assert_array_equal(found.material_rgb[1, 3], task.model.mat_rgba[:, :3].astype(np.float32))


@pytest.mark.parametrize(
    ("task_id", "difficulty", "scale"),
    [("walker-walk", "hard", 0.3), ("cheetah-run", "medium", 0.2), ("humanoid-walk", "easy", 0.1)],
)
def test_dynamic_stays_in_its_ranges(task_id, difficulty, scale):
    task = get_task(task_id)
    physics = physics_of(task, episodes=4, frames=120)
    found = labels(task, f"dynamic_{difficulty}", physics)
    agent = centers_of_mass(task, physics.reshape(-1, physics.shape[-1])).reshape(4, 120, 3)
    radius, polar, azimuth = spherical(np.moveaxis(found.camera_position[:, :, 0] - agent, -1, 0))
    azimuth = np.where(azimuth > 3, azimuth - 2 * np.pi, azimuth)  # the seam: pi is -pi
    nominal = task.model.cam_poscom0[camera_ids(task)[0]]
    r0, polar0, azimuth0 = spherical(nominal)
    slack = 1e-5  # labels are float32
    assert radius.min() >= r0 * (1 - 0.5 * scale) - slack and radius.max() <= r0 * (1 + 1.5 * scale) + slack
    assert np.abs(polar - polar0).max() <= np.pi / 2 * scale + slack and polar.max() <= np.pi / 2 + slack
    assert np.abs(azimuth - azimuth0).max() <= np.pi / 2 * scale + slack
    assert azimuth.min() >= -np.pi - slack and azimuth.max() <= slack
    own = task.model.mat_rgba[:, :3]
    assert np.abs(found.material_rgb - own).max() <= scale + slack
    assert found.material_rgb.min() >= 0 and found.material_rgb.max() <= 1
    speed = np.linalg.norm(np.diff(found.camera_position[:, :, 0] - agent, axis=1), axis=-1)
    assert speed.max() <= 2 * 0.4 * scale * r0 / 4 + slack  # two ticks a frame


def test_the_seam_of_azimuths_is_at_minus_pi():
    np.testing.assert_allclose(spherical(np.array([-2.0, 0, 0])), [2, np.pi / 2, -np.pi])


@pytest.mark.parametrize("difficulty", ["easy", "hard", "0.02"])
@pytest.mark.parametrize("task_id", ["quadruped-walk", "fish-upright", "acrobot-swingup", "manipulator-bring_ball"])
def test_the_range_is_around_every_nominal_camera(task_id, difficulty):
    task = get_task(task_id)
    offset = task.model.cam_poscom0[camera_ids(task)[0]]
    setting = DistractorSetting("dynamic", difficulty)
    bounds, nominal = camera_range(offset, setting), spherical(offset)
    assert (bounds.low <= bounds.high).all()
    assert (np.abs(np.stack([bounds.low, bounds.high]) - nominal)[:, 1:] <= np.pi / 2 * setting.scale + 1e-9).all()
    walks, _ = camera_walk(bounds, setting, 60, [np.random.default_rng(seed) for seed in range(4)])
    places = spherical(walks.T).T
    assert (places >= bounds.low - 1e-6).all() and (places <= bounds.high + 1e-6).all()


@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_the_camera_looks_where_the_nominal_one_does(task_id):
    """MuJoCo's own camera of every moment, its line of sight as far as the agent's centre of mass is away."""
    task, frames = get_task(task_id), 40
    physics = physics_of(task, frames=frames)
    found = labels(task, "dynamic", physics)
    body = task.model.cam_bodyid[0]
    beside = []
    for episode, frame in np.ndindex(2, frames):
        data = posed(task.model, physics[episode, frame], PHYSICS_SPEC)
        center, nominal = data.subtree_com[body], data.cam_xpos[0]
        back = data.cam_xmat[0].reshape(3, 3)[:, 2]
        target = nominal - back * np.linalg.norm(center - nominal)
        wanted = target - found.camera_position[episode, frame, 0]
        rotation = matrices(found.camera_quaternion[episode, frame, 0].astype(float))
        np.testing.assert_allclose(-rotation[:, 2], wanted / np.linalg.norm(wanted), atol=1e-5)
        beside.append(np.arccos((center - nominal) @ -back / np.linalg.norm(center - nominal)))
    if task_id != "humanoid-walk":  # looking at the centre of mass itself would be another picture
        np.testing.assert_allclose(beside, {"walker-walk": 0.024, "cheetah-run": 0.046}[task_id], rtol=0.2)


@pytest.mark.parametrize("scale", [0.001, 0.2])
@pytest.mark.parametrize("task_id", ["reacher-easy", "point_mass-easy", "fish-swim", "walker-walk"])
def test_pictures_turn_no_more_than_the_scale_says(task_id, scale):
    """Also of cameras straight overhead, around which azimuth turns by any angle in no time."""
    task = get_task(task_id)
    physics = np.repeat(physics_of(task, 8, 1), 100, axis=1)
    found = labels(task, f"dynamic_camera{scale}", physics)
    nominal = matrices(nominal_cameras(task, physics[0, :1])[1][0, 0].astype(float))
    axes = matrices(found.camera_quaternion[:, :, 0].astype(float))
    angle = np.pi / 2 * scale
    from_nominal = Rotation.from_matrix((axes @ nominal.T).reshape(-1, 3, 3)).magnitude()
    assert from_nominal.max() < 3 * angle + 1e-3 and np.ptp(from_nominal) > angle
    right = axes[..., 0]
    assert np.arccos(np.clip((right[:, 1:] * right[:, :-1]).sum(-1), -1, 1)).max() < angle / 2 + 1e-3
    place = centers_of_mass(task, physics[0, :1])[0] + task.model.cam_poscom0[camera_ids(task)[0]]
    moved = (found.camera_position[:, :, 0] - place) @ nominal[:, :2]  # to the picture's right and top: either way
    assert (moved.min(axis=(0, 1)) < 0).all() and (moved.max(axis=(0, 1)) > 0).all()


def test_static_varies_between_episodes_and_never_within_one():
    task = get_task("walker-walk")
    physics = physics_of(task, episodes=6, frames=30)
    found = labels(task, "static", physics)
    agent = centers_of_mass(task, physics.reshape(-1, physics.shape[-1])).reshape(6, 30, 3)
    offset = found.camera_position[:, :, 0] - agent
    for values in (offset, found.camera_quaternion, found.material_rgb, found.background_video, found.background_frame):
        np.testing.assert_allclose(values, np.broadcast_to(values[:, :1], values.shape), atol=1e-5)
    assert len(np.unique(found.material_rgb[:, 0].reshape(6, -1), axis=0)) == 6


def test_roll_has_the_steps_and_limits_it_should():
    setting = DistractorSetting("dynamic", "hard")
    rngs = [np.random.default_rng(i) for i in range(3000)]
    bounds = camera_range(np.array([0.0, -4.0, 2.0]), setting)
    _, roll = camera_walk(bounds, setting, 3, rngs)
    start = roll[:, 0] / bounds.roll
    assert kstest(start, "uniform", (-1, 2)).pvalue > 1e-3
    step, top = np.diff(roll, axis=1), 2 * 0.3 * np.pi / 50  # two ticks a frame
    assert np.abs(step).max() <= top + 1e-12
    # A frame's step is v1 + v2, the next one's v3 + v4; they differ by e2 + 2 e3 + e4: sqrt(6) standard deviations.
    free = (np.abs(start) < 0.7) & (np.abs(step[:, 0]) < top / 2)
    assert np.diff(step, axis=1)[free, 0].std() == pytest.approx(np.sqrt(6) * 0.3 * np.pi / 300, rel=0.05)
    first = step[np.abs(start) < 0.7, 0] / top  # starts at any speed below the top one, either way
    assert np.abs(first).mean() == pytest.approx(0.5, abs=0.05) and abs(first.mean()) < 0.05


def test_camera_speeds_are_those_of_a_capped_random_walk():
    setting, count = DistractorSetting("dynamic", "medium"), 2000
    anywhere = CameraRange(np.array([1e-3, 0.0, -np.pi]), np.array([1e3, np.pi, np.pi]), 3.0, 1.0)
    offset, _ = camera_walk(anywhere, setting, 16, [np.random.default_rng(i) for i in range(count)])
    steps = np.linalg.norm(np.diff(offset, axis=1), axis=-1)
    rng, unit = np.random.default_rng(1), 0.2 * 3.0 / 4  # the walk again, with no place to walk in
    heading = rng.normal(size=(count, 3))
    velocity = heading / np.linalg.norm(heading, axis=1, keepdims=True) * rng.uniform(0, 0.4 * unit, (count, 1))
    for frame in range(15):
        moved = np.zeros((count, 3))
        for _ in range(2):
            velocity += rng.normal(0, 0.1 * unit, (count, 3))
            velocity /= np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True) / (0.4 * unit), 1)
            moved += velocity
        if frame in (0, 5, 14):
            assert ks_2samp(steps[:, frame], np.linalg.norm(moved, axis=1)).pvalue > 1e-3


def test_colors_start_uniform_and_step_as_far_as_they_should():
    task = get_task("walker-walk")
    physics = np.repeat(physics_of(task, 1, 3), 60, axis=0)
    colors = labels(task, "dynamic_hard", physics).material_rgb.astype(float)
    own = task.model.mat_rgba[:, :3].astype(float)
    seen = np.isin(np.arange(len(own)), task.model.geom_matid)
    assert (colors[:, :, ~seen] == own[~seen].astype(np.float32)).all()
    low, high = np.clip(own - 0.3, 0, 1)[seen], np.clip(own + 0.3, 0, 1)[seen]
    start = (colors[:, 0, seen] - low) / (high - low)  # white floors too: uniform in [0.7, 1], not half of them at 1
    assert kstest(start.ravel(), "uniform").pvalue > 1e-3
    change, middle = np.diff(colors, axis=1)[:, 0][:, seen], np.abs(start - 0.5) < 0.3
    assert change[middle].std() == pytest.approx(np.sqrt(2) * 0.03 * 0.3, rel=0.1)


@pytest.mark.parametrize(
    ("start", "direction", "length", "expected"),
    [(3, 1, 5, [3, 4, 3, 2, 1, 0, 1, 2, 3, 4]), (1, -1, 3, [1, 0, 1, 2, 1]), (0, 1, 1, [0, 0])],
)
def test_ping_pong_walks_to_the_ends_and_back(start, direction, length, expected):
    assert ping_pong(start, direction, np.arange(len(expected)), length).tolist() == expected


def test_the_video_moves_a_frame_every_ten_ticks():
    task = get_task("walker-walk")
    found = labels(task, "dynamic", physics_of(task, episodes=3, frames=101))
    moved = np.abs(np.diff(found.background_frame.astype(int), axis=1))
    steps = np.flatnonzero(moved[0])
    assert set(np.unique(moved)) == {0, 1}
    np.testing.assert_array_equal((steps + 1) % 5, 0)  # five agent steps of two ticks
    assert len(steps) == 20
    assert (found.background_video == found.background_video[:, :1]).all()


@pytest.mark.parametrize(("frames", "setting"), [(2, "dynamic"), (17, "static"), (29, "dynamic")])
def test_an_episodes_labels_depend_on_nothing_but_itself(frames, setting):
    task = get_task("walker-walk")
    physics = physics_of(task, episodes=3, frames=30)
    whole = labels(task, setting, physics)
    alone = labels(task, setting, physics[1:2, :frames], episodes=[1])
    for (name, a), (_, b) in zip(whole.items(), alone.items(), strict=True):
        np.testing.assert_array_equal(a[1:2, :frames], b, err_msg=name)


class Own(Distractor):
    """Colors that a test draws: (frames, material, 3) -> those of one episode, from its generator."""

    kinds, stream, names = ("own",), "color", ("material_rgb",)
    made = []

    def __init__(self, scene, generators):
        self.made.append(len(generators))
        shape = scene.frames, *scene.task.material_colors.shape
        drawn = self.draw([rng.uniform(size=shape) for rng in generators])
        self.drawn = drawn if isinstance(drawn, dict) else {"material_rgb": drawn}

    def draw(self, colors):
        return np.stack(colors)


WRONG = {
    "count": (lambda self, colors: np.stack(colors) / len(self.made), "gives other material_rgb for the same episode"),
    "no seed": (lambda self, colors: np.random.random(np.shape(colors)), "gives other material_rgb"),
    "neighbors": (lambda self, colors: colors - np.min(colors, axis=0), "gives other material_rgb"),
    "last frame": (lambda self, colors: np.array(colors)[:, ::-1], "gives other material_rgb"),
    "NaN": (lambda self, colors: np.full_like(colors, np.nan), "from nan to nan; give finite numbers from 0 to 1"),
    "huge": (lambda self, colors: np.full_like(colors, 1e30), "from 1e.30 to 1e.30; give finite numbers from 0 to 1"),
    "negative": (lambda self, colors: -np.array(colors), "give finite numbers from 0 to 1"),
    "short": (lambda self, colors: np.array(colors)[:, 1:], "of shape .2, 40, 13, 3.; give numbers of shape .2, 41,"),
    "one": (lambda self, colors: np.array(colors)[:, 0], "as float64 of shape .2, 13, 3.; give numbers of shape"),
    "flat": (lambda self, colors: np.zeros(2), "failed .IndexError: too many"),
    "words": (lambda self, colors: np.full(np.shape(colors), "red"), "as <U3 of shape"),
    "nothing": (lambda self, colors: {}, "gives no material_rgb; give it, or leave it out of `names`"),
    "list": (lambda self, colors: {"material_rgb": colors}, "failed .TypeError: list indices"),
    "fails": (lambda self, colors: colors["red"], "failed .TypeError: list indices"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_a_distractor_of_ones_own_that_gives_other_labels_than_it_should_is_named(wrong, monkeypatch):
    monkeypatch.setenv(DISTRACTORS, f"{__name__}:Own")
    task = get_task("walker-walk")
    physics = np.repeat(physics_of(task, 2, 1), 41, axis=1)
    assert np.ptp(labels(task, "own", physics).material_rgb) > 0.9
    draw, words = WRONG[wrong]
    monkeypatch.setattr(Own, "draw", draw)
    with pytest.raises(DmcvbError, match=words) as caught:
        labels(task, "own", physics)
    assert str(caught.value).startswith(f"distractor {__name__}:Own ") and "\n" not in str(caught.value)


class Halved(Own):
    """Halves what it drew, in place."""

    def adjust(self, found, actions, frames):
        found["material_rgb"] *= 0.5


class Unturned(Own):
    names = ("camera_position", "camera_quaternion")

    def labels(self, physics, frames):
        return {name: np.zeros((*physics.shape[:-1], 1, size)) for name, size in zip(self.names, (3, 4), strict=True)}


class Steered(Own):
    stream = "policy"


def test_a_distractor_of_ones_own_may_write_into_the_labels_that_it_is_given(monkeypatch):
    monkeypatch.setenv(DISTRACTORS, f"{__name__}:Halved")
    monkeypatch.setattr(Halved, "kinds", ("halved",))
    task, setting = get_task("walker-walk"), DistractorSetting.parse("halved")
    sampler = DistractorSampler(task, setting, 4, generators(range(2)), load_backgrounds())
    once, again = (sampler.labels(physics_of(task, 2, 1)[:, 0], frame=3).material_rgb for _ in range(2))
    np.testing.assert_array_equal(once, again)
    assert 0.45 < once.max() <= 0.5


@pytest.mark.parametrize(
    ("kind", "words"),
    [(Unturned, "gives a camera_quaternion of zeros, which is no rotation"), (Steered, "a stream out of .'camera'")],
)
def test_a_distractor_of_ones_own_that_cannot_be_is_refused(kind, words, monkeypatch):
    name = kind.__name__.lower()
    monkeypatch.setenv(DISTRACTORS, f"{__name__}:{kind.__name__}")
    monkeypatch.setattr(kind, "kinds", (name,))
    with pytest.raises(DmcvbError, match=words):
        labels(get_task("walker-walk"), name, physics_of(get_task("walker-walk"), 2, 3))


class Odd(WalkerWalk):
    """Two views, lamps below, actions from 0 to 1."""

    views, cameras = ("side", "back"), (0, 1)
    action_low = np.zeros(6, np.float32)

    def __init__(self):
        super().__init__()
        self.model = copy.deepcopy(self.model)
        self.model.light_pos[:, 2] *= -1


def test_one_view_is_moved_and_the_others_are_the_tasks_own():
    task, walker = Odd(), get_task("walker-walk")
    physics = physics_of(walker, 2, 5)
    found, single = labels(task, "dynamic", physics), labels(walker, "dynamic", physics)
    own = dict(zip(("camera_position", "camera_quaternion"), nominal_cameras(task, physics), strict=True))
    for name, values in own.items():
        np.testing.assert_array_equal(getattr(found, name)[..., :1, :], getattr(single, name))
        np.testing.assert_array_equal(getattr(found, name)[..., 1:, :], values[..., 1:, :])


def test_lamps_below_move_as_those_above_and_cues_follow_actions_of_other_bounds():
    task, walker = Odd(), get_task("walker-walk")
    physics, actions = physics_of(walker, 2, 5), np.tile([[0.9], [0.1], [0.7], [0.2], [0.6]], (2, 1, 6))
    shifts = [labels(each, "dynamic_light0.5", physics).light_shift for each in (task, walker)]
    np.testing.assert_array_equal(*shifts)
    setting = DistractorSetting.parse("dynamic_cue1")
    shown = sample_distractors(task, setting, physics, generators(range(2)), None, actions=actions).material_rgb
    lighter = shown.mean(axis=(2, 3)) > task.material_colors.mean()
    np.testing.assert_array_equal(lighter, actions[..., 0] > 0.5)


def test_a_camera_in_the_agents_center_cannot_move_around_it():
    task = Odd()
    task.model.cam_poscom0[:] = 0
    with pytest.raises(DmcvbError, match="has its camera in the agent's center; let others than camera vary"):
        labels(task, "dynamic", physics_of(get_task("walker-walk"), 2, 2))


def test_difficulty_decides_how_many_videos_are_in_play():
    task = get_task("walker-walk")
    physics = np.repeat(physics_of(task, 1, 2), 200, axis=0)
    backgrounds = load_backgrounds("builtin", "train")
    for difficulty, videos in (("easy", 4), ("medium", 8), ("hard", len(backgrounds))):
        seen = labels(task, f"static_{difficulty}", physics).background_video
        assert set(np.unique(seen)) == set(range(videos))
