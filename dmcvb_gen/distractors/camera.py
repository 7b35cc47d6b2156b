"""The camera distractor: a camera that drifts around the agent and looks at it.

The camera moves in spherical coordinates around the agent's centre of mass, so its walk is drawn without
the trajectory; the centre of mass of each frame is added last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.distractors.base import Distractor, DistractorSetting, Scene
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks.base import ACTION_REPEAT
from dmcvb_gen.tasks.cameras import camera_ids, centers_of_mass, nominal_cameras, quaternions

VELOCITY_STD = 0.1  # of a tick's change of velocity, times s and r0 / 4, meters a tick
MAX_SPEED = 0.4  # times s and r0 / 4, meters a tick
ROLL_VELOCITY_STD = np.pi / 300  # times s, radians a tick
MAX_ROLL_SPEED = np.pi / 50  # times s, radians a tick
ANGLE_RANGE = np.pi / 2  # times s: half width of azimuth, elevation and roll, radians
RADIUS_RANGE = (0.5, 1.5)  # times s: how much nearer and farther than r0, as a share of r0
OVERHEAD = 0.9  # a nominal camera is overhead (or below) if more than this share of its distance is vertical


@dataclass(frozen=True)
class CameraRange:
    """Range of the camera: radius (m), polar angle from +z, azimuth, roll (radians)."""

    low: np.ndarray
    high: np.ndarray
    nominal_radius: float
    roll: float


def spherical(position: np.ndarray) -> np.ndarray:
    """(3, ...) x y z -> (3, ...) radius, polar angle, azimuth in [-pi, pi)."""
    x, y, z = position
    radius = np.sqrt(x * x + y * y + z * z)
    cosine = np.clip(z / radius, -1, 1)
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    polar, azimuth = arithmetic.arctan2(np.stack([sine, y]), np.stack([cosine, x]))
    return np.stack([radius, polar, np.where(azimuth >= np.pi - 1e-9, azimuth - 2 * np.pi, azimuth)])


def cartesian(coordinates: np.ndarray) -> np.ndarray:
    """(3, ...) radius, polar angle, azimuth -> (3, ...) x y z."""
    (sin_polar, sin_azimuth), (cos_polar, cos_azimuth) = arithmetic.sin_cos(coordinates[1:])
    flat = coordinates[0] * sin_polar
    return np.stack([flat * cos_azimuth, flat * sin_azimuth, coordinates[0] * cos_polar])


def turned(axes: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Sum of the columns of `axes`, (3, 3), weighed by each of the vectors (..., 3)."""
    return arithmetic.total(axes.T.reshape(3, *(1,) * (vectors.ndim - 1), 3) * np.moveaxis(vectors, -1, 0)[..., None])


def camera_range(offset: np.ndarray, setting: DistractorSetting, overhead: bool = False) -> CameraRange:
    """The ranges around a nominal camera.

    The camera stays above the agent's center of mass and on its side of the plane y = 0, in front of the scenery. A
    nominal camera that is below keeps its range if no part of that is above.

    Args:
      offset: (3,) nominal camera minus centre of mass, meters.
      overhead: z points to the top of the nominal image, in which the camera may also go down.
    """
    radius, polar, azimuth = spherical(offset)
    scale = setting.scale_of("camera")
    angle = ANGLE_RANGE * scale
    horizon = np.pi / 2 if polar - angle < np.pi / 2 and not overhead else np.pi
    side = (-np.pi, 0.0) if azimuth <= 0 else (0.0, np.pi)
    low = np.array([radius * (1 - RADIUS_RANGE[0] * scale), max(polar - angle, 0.0), max(azimuth - angle, side[0])])
    high = np.array(
        [radius * (1 + RADIUS_RANGE[1] * scale), min(polar + angle, horizon), min(azimuth + angle, side[1])]
    )
    return CameraRange(low, high, float(radius), angle)


def camera_walk(
    bounds: CameraRange,
    setting: DistractorSetting,
    frames: int,
    generators: Sequence[np.random.Generator],
    repeat: int = ACTION_REPEAT,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the camera's walk, relative to the agent.

    Place and roll start uniform in their ranges, speeds uniform below their limits in a random direction. Where
    a range ends, the camera stops pushing outwards, as in the Distracting Control Suite: it slides along the end
    and leaves it with the next step inwards. Static cameras start like dynamic ones of the same streams.

    Args:
      repeat: control steps, and so ticks, a frame.

    Returns:
      offset (episode, frame, 3) meters from the centre of mass, roll (episode, frame) radians. A longer
      walk begins with the shorter one.
    """
    start = np.stack([rng.random(4) for rng in generators])
    position = cartesian((bounds.low + start[:, :3] * (bounds.high - bounds.low)).T)
    roll = (2 * start[:, 3] - 1) * bounds.roll
    offsets = np.empty((len(generators), frames, 3))
    rolls = np.empty((len(generators), frames))
    offsets[:], rolls[:] = position.T[:, None], roll[:, None]
    if setting.kind != "dynamic":
        return offsets, rolls
    scale = setting.scale_of("camera")
    unit, limit = scale * bounds.nominal_radius / 4, MAX_ROLL_SPEED * scale
    heading = np.stack([arithmetic.normal(rng, (3,)) for rng in generators])
    share = np.stack([rng.random(2) for rng in generators])  # of the top speeds
    velocity = heading / arithmetic.norm(heading, axis=1, keepdims=True) * share[:, :1] * MAX_SPEED * unit
    roll_velocity = (2 * share[:, 1] - 1) * limit
    ticks = repeat * (frames - 1)
    # The coordinate comes first from here on, and calls are few: of a loop over ticks they are what takes the time.
    noise = np.stack([arithmetic.normal(rng, (ticks, 4)).T for rng in generators], axis=-1)  # (4, tick, episode)
    pushes, twists = VELOCITY_STD * unit * noise[:3], ROLL_VELOCITY_STD * scale * noise[3]
    velocity = velocity.T
    for tick in range(ticks):
        velocity = velocity + pushes[:, tick]
        velocity *= np.minimum(1.0, MAX_SPEED * unit / np.maximum(arithmetic.norm(velocity, axis=0), 1e-12))
        reached = _within(position + velocity, bounds)
        position, velocity = reached, reached - position  # a limit takes the speed towards it
        roll_velocity = np.clip(roll_velocity + twists[tick], -limit, limit)
        rolled = np.clip(roll + roll_velocity, -bounds.roll, bounds.roll)
        roll, roll_velocity = rolled, rolled - roll
        if (tick + 1) % repeat == 0:
            frame = (tick + 1) // repeat
            offsets[:, frame], rolls[:, frame] = position.T, roll
    return offsets, rolls


def _within(position: np.ndarray, bounds: CameraRange) -> np.ndarray:
    """Move places, (3, episode) x y z, into the ranges.

    A camera just past the azimuth's seam at pi is past its near end, not its far one.
    """
    radius, polar, azimuth = spherical(position)
    middle = (bounds.low[2] + bounds.high[2]) / 2
    azimuth = middle + (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
    return cartesian(np.clip(np.stack([radius, polar, azimuth]), bounds.low[:, None], bounds.high[:, None]))


def look_at(offset: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Camera matrices that look at a point, then roll about the line of sight.

    Args:
      offset: (..., 3) from that point to the camera.
      roll: (...,) radians.

    Returns:
      (..., 3, 3), columns: the camera's x (right), y (up) and z (away from the agent) in the world frame.
    """
    back = offset / arithmetic.norm(offset, axis=-1, keepdims=True)
    right = np.stack([-back[..., 1], back[..., 0], np.zeros(back.shape[:-1])], axis=-1)  # z cross back
    norm = arithmetic.norm(right, axis=-1, keepdims=True)
    right = np.where(norm > 1e-9, right / np.maximum(norm, 1e-9), np.array([0.0, -1.0, 0.0]))  # straight above
    up = np.cross(back, right)
    sin, cos = (part[..., None] for part in arithmetic.sin_cos(roll))
    return np.stack([cos * right + sin * up, cos * up - sin * right, back], axis=-1)


class Camera(Distractor):
    """The first view's camera moves around the agent; the others, and without it all, are the task's own."""

    kinds = ("static", "dynamic")
    stream = "camera"
    names = ("camera_position", "camera_quaternion")

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        self._task, model, camera = scene.task, scene.task.model, camera_ids(scene.task)[0]
        offset, rotation = np.asarray(model.cam_poscom0[camera]), model.cam_mat0[camera].reshape(3, 3)
        if not arithmetic.norm(offset) > 0:
            raise DmcvbError(f"{scene.task.id} has its camera in the agent's center; let others than camera vary")
        overhead = bool(abs(offset[2]) > OVERHEAD * arithmetic.norm(offset))
        if overhead:  # walk as if the nominal image stood upright: right is x, into the image y, up z
            axes = np.stack([rotation[:, 0], -rotation[:, 2], rotation[:, 1]], axis=1)
            offset, rotation = turned(axes.T, offset), turned(axes.T, rotation.T).T
        bounds = camera_range(offset, scene.setting, overhead)
        walk, roll = camera_walk(bounds, scene.setting, scene.frames, generators, scene.task.action_repeat)
        # Nominal cameras look a little off the agent's centre of mass, and so does the walking one.
        target = offset - arithmetic.norm(offset) * rotation[:, 2]
        matrices = look_at(walk - target, roll)
        if overhead:
            walk, matrices = turned(axes, walk), turned(axes, matrices.swapaxes(-1, -2)).swapaxes(-1, -2)
        self._offset, self._quaternion = walk, quaternions(matrices)

    def labels(self, physics: np.ndarray, frames: int | slice) -> Mapping[str, np.ndarray]:
        agent = centers_of_mass(self._task, physics)
        moved = [(agent + self._offset[:, frames])[..., None, :], self._quaternion[:, frames][..., None, :]]
        if len(self._task.views) > 1:
            own = (values[..., 1:, :] for values in nominal_cameras(self._task, physics))
            moved = [np.concatenate(pair, axis=-2) for pair in zip(moved, own, strict=True)]
        return dict(zip(self.names, moved, strict=True))

    @classmethod
    def nominal(cls, scene: Scene, physics: np.ndarray) -> Mapping[str, np.ndarray]:
        return dict(zip(cls.names, nominal_cameras(scene.task, physics), strict=True))
