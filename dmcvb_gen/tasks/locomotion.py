"""walker-walk, cheetah-run and humanoid-walk: dm_control's models, simulated as batches of episodes.

The three tasks answer the questions of dm_control's suite (initial state, state, reward) for a whole
batch. dm_control is the authority: from the same physics state and actions they give its numbers.
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.tasks.base import Generators, PhysicsBatch, Task, tolerance
from dmcvb_gen.tasks.suite import suite_folder

EPISODE_STEPS = 500
"""Agent steps an episode: 1000 control steps at action repeat 2 (paper, section 3.1)."""


def _suite_model(domain: str) -> mujoco.MjModel:
    """The compiled model of a domain of dm_control's suite, whose XML files are read in place."""
    suite = suite_folder()
    assets = {f"./common/{path.name}": path.read_bytes() for path in (suite / "common").glob("*.xml")}
    mujoco.set_mju_user_warning(lambda message: None)  # an attribute of the cheetah's file is deprecated
    try:
        return mujoco.MjModel.from_xml_string((suite / f"{domain}.xml").read_text(), assets)
    finally:
        mujoco.set_mju_user_warning(None)


class LocomotionTask(Task):
    """A suite task of 1000 control steps that only the clock ends."""

    domain: str
    batch_class: type[LocomotionBatch]
    max_steps = evaluation_steps = EPISODE_STEPS
    return_range = (0.0, 1000.0)

    @functools.cached_property
    def model(self) -> mujoco.MjModel:
        return _suite_model(self.domain)

    def batch(self, size: int, threads: int = 1) -> PhysicsBatch:
        return self.batch_class(self, size, threads)


class LocomotionBatch(PhysicsBatch):
    """What the three batches measure."""

    def __init__(self, task: Task, size: int, threads: int = 1):
        super().__init__(task, size, threads)
        self._torso = task.model.body("torso").id
        self._velocity = int(task.model.sensor("torso_subtreelinvel").adr[0])

    def torso_upright(self):
        """Projection of the torso's z axis on the world's."""
        return self._xmat[:, self._torso, 8]

    def com_velocity(self):
        """Velocity of the centre of mass, m/s, (size, 3)."""
        return self._sensors[:, self._velocity : self._velocity + 3]

    def _randomize_joints(self, ids: np.ndarray, generators: Generators) -> None:
        """Limited joints uniform in their range, free hinges in [-pi, pi], free bodies turned at random.

        The free joint's quaternion is drawn from the unit cube and normalized, as dm_control does.
        """
        model, qpos = self.task.model, self._qpos
        for sim, rng in zip(ids, generators, strict=True):
            for joint in range(model.njnt):
                address, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
                if model.jnt_limited[joint]:
                    qpos[sim, address] = rng.uniform(*model.jnt_range[joint])
                elif kind == mujoco.mjtJoint.mjJNT_HINGE:
                    qpos[sim, address] = rng.uniform(-np.pi, np.pi)
                elif kind == mujoco.mjtJoint.mjJNT_FREE:
                    quaternion = rng.random(4)
                    qpos[sim, address + 3 : address + 7] = quaternion / arithmetic.norm(quaternion)


# -- walker-walk --------------------------------------------------------------------------------

WALKER_STAND_HEIGHT = 1.2  # torso height (m) above which standing is fully rewarded
WALKER_SPEED = 1.0  # horizontal speed (m/s) above which walking is fully rewarded


class WalkerBatch(LocomotionBatch):
    def _initialize(self, ids, generators):
        self._randomize_joints(ids, generators)
        self._refresh(ids)

    def torso_height(self):
        return self._xpos[:, self._torso, 2]

    def state(self):
        orientations = self._xmat[:, 1:][:, :, [0, 2]].reshape(self.size, -1)  # xx and xz of every body
        return np.concatenate([orientations, self.torso_height()[:, None], self._qvel], axis=1)

    def _control_reward(self):
        standing = tolerance(self.torso_height(), WALKER_STAND_HEIGHT, margin=WALKER_STAND_HEIGHT / 2)
        upright = (1 + self.torso_upright()) / 2
        stand, speed = (3 * standing + upright) / 4, self.com_velocity()[:, 0]
        move = tolerance(speed, WALKER_SPEED, margin=WALKER_SPEED / 2, value_at_margin=0.5, sigmoid="linear")
        return stand * (5 * move + 1) / 6


class WalkerWalk(LocomotionTask):
    """A planar walker that walks at 1 m/s."""

    floor_alpha = 1.0

    id, domain, batch_class = "walker-walk", "walker", WalkerBatch
    substeps = 10  # 2.5 ms physics, 25 ms control
    state_fields = {"orientations": 14, "height": 1, "velocity": 9}


# -- cheetah-run --------------------------------------------------------------------------------

CHEETAH_SPEED = 10.0  # m/s, fully rewarded
CHEETAH_SETTLING_STEPS = 200  # physics steps that let the cheetah fall before the episode starts


class CheetahBatch(LocomotionBatch):
    def _initialize(self, ids, generators):
        model = self.task.model
        limited = model.jnt_qposadr[model.jnt_limited == 1]
        low, high = model.jnt_range[model.jnt_limited == 1].T
        for sim, rng in zip(ids, generators, strict=True):
            self._qpos[sim, limited] = rng.uniform(low, high)
        self._ctrl[ids] = 0
        self.sims.step(ids=ids, nstep=CHEETAH_SETTLING_STEPS)
        self.sims.bind("time")[ids] = 0
        self._refresh(ids)

    def state(self):
        return np.concatenate([self._qpos[:, 1:], self._qvel], axis=1)  # the horizontal position is left out

    def _control_reward(self):
        speed = self.com_velocity()[:, 0]
        return tolerance(speed, CHEETAH_SPEED, margin=CHEETAH_SPEED, value_at_margin=0, sigmoid="linear")


class CheetahRun(LocomotionTask):
    """A planar cheetah that runs at 10 m/s."""

    floor_alpha = 1.0

    id, domain, batch_class = "cheetah-run", "cheetah", CheetahBatch
    substeps = 1  # 10 ms physics and control
    state_fields = {"position": 8, "velocity": 9}


# -- humanoid-walk ------------------------------------------------------------------------------

HUMANOID_STAND_HEIGHT = 1.4  # head height (m) above which standing is fully rewarded
HUMANOID_SPEED = 1.0  # m/s, fully rewarded


class HumanoidBatch(LocomotionBatch):
    def __init__(self, task, size, threads=1):
        super().__init__(task, size, threads)
        body = task.model.body
        self._ncon, self._head = self.sims.bind("ncon"), body("head").id
        self._limbs = [body(side + limb).id for side in ("left_", "right_") for limb in ("hand", "foot")]

    def _initialize(self, ids, generators):
        # Redraw the poses that touch anything, each from its own generator, until none does.
        pending, rngs = np.asarray(ids), dict(zip(ids, generators, strict=True))
        while len(pending):
            self._randomize_joints(pending, [rngs[i] for i in pending])
            self._refresh(pending)
            pending = pending[self._ncon[pending] > 0]

    def head_height(self):
        return self._xpos[:, self._head, 2]

    def extremities(self):
        """Hands and feet in the torso's frame, left hand, left foot, right hand, right foot, (size, 12)."""
        torso_to_limb = self._xpos[:, self._limbs] - self._xpos[:, self._torso, None]
        frame = self._xmat[:, self._torso].reshape(self.size, 3, 3)
        turned = arithmetic.total((torso_to_limb[..., None] * frame[:, None]).transpose(2, 0, 1, 3))
        return turned.reshape(self.size, 12)

    def state(self):
        torso = self.com_velocity(), self.extremities(), self.head_height()[:, None]
        return np.concatenate([*torso, self._qpos[:, 7:], self._xmat[:, self._torso, 6:9], self._qvel], axis=1)

    def _control_reward(self):
        standing = tolerance(self.head_height(), HUMANOID_STAND_HEIGHT, margin=HUMANOID_STAND_HEIGHT / 4)
        upright = tolerance(self.torso_upright(), 0.9, margin=1.9, value_at_margin=0, sigmoid="linear")
        control = tolerance(self._ctrl, 0.0, 0.0, value_at_margin=0, sigmoid="quadratic").mean(axis=1)
        small_control, speed = (4 + control) / 5, arithmetic.norm(self.com_velocity()[:, :2])
        move = tolerance(speed, HUMANOID_SPEED, margin=HUMANOID_SPEED, value_at_margin=0, sigmoid="linear")
        return small_control * standing * upright * (5 * move + 1) / 6


class HumanoidWalk(LocomotionTask):
    """A humanoid that walks at 1 m/s."""

    id, domain, batch_class = "humanoid-walk", "humanoid", HumanoidBatch
    substeps = 5  # 5 ms physics, 25 ms control
    state_fields = {
        "com_velocity": 3,
        "extremities": 12,
        "head_height": 1,
        "joint_angles": 21,
        "torso_vertical": 3,
        "velocity": 27,
    }
