"""Tasks of a user's own that do what is easily lost or cannot be repeated; each function gives an environment."""

from __future__ import annotations

import functools
import random

import numpy as np
from dm_control import mujoco
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

ARM = """<mujoco><option timestep="0.01"/>
<asset><texture type="skybox" builtin="flat" width="8" height="8" rgb1=".5 .2 .1"/>
<material name="m" rgba="1 0 0 1"/></asset>
<worldbody><light pos="0 0 3"/><camera name="side" pos="0 -2 1" xyaxes="1 0 0 0 .4 1"/>
<body name="hand" mocap="true" pos=".6 0 .9"><geom type="sphere" size=".05" rgba="0 1 0 1"/></body>
<body name="arm" pos="0 0 .8"><joint name="hinge" axis="0 1 0" damping=".1"/>
<geom name="rod" type="capsule" size=".05" fromto="0 0 0 .5 0 0" material="m"/>
<body pos=".5 0 0"><joint name="wrist" axis="0 1 0"/><geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/></body>
</body></worldbody>
<actuator><motor name="first" joint="hinge" ctrlrange="-1 1"/><motor joint="wrist" ctrlrange="-1 1"/></actuator>
<sensor><actuatorfrc actuator="first"/></sensor></mujoco>"""
TRIPLE = [[1.0, 0.0], [0.0, 1.0], [0.5, -0.5]]
MODULE_GENERATOR = np.random.default_rng(7)


class Arm(base.Task):
    """Starts at random, earns the height of the hand; what is hostile is added by subclasses."""

    def initialize_episode(self, physics):
        physics.data.qpos[:] = self.random.uniform(-1, 1, 2)
        self.start(physics)
        super().initialize_episode(physics)

    def start(self, physics):
        pass

    def get_observation(self, physics):
        return {"position": physics.data.qpos.copy(), "velocity": physics.data.qvel.copy()}

    def get_reward(self, physics):
        return float(physics.data.xpos[-1, 2])


def arm(task=None, xml=ARM, kind=control.Environment, **options):
    options = {"time_limit": 0.5, "control_timestep": 0.02} | options
    return kind(mujoco.Physics.from_xml_string(xml), task or Arm(), **options)


def having(name, **methods):
    """A task with other methods."""
    return type(name, (Arm,), methods)


# -- what is stored as dm_control does it -----------------------------------------------------------


def plain():
    return arm()


class WritesIntoTheSimulation(Arm):
    """Forces and a mocap body, at the start, before and after each step."""

    def start(self, physics):
        physics.data.qfrc_applied[:] = self.random.uniform(-1, 1, 2)

    def before_step(self, action, physics):
        physics.data.xfrc_applied[-1, 0] = 3 * np.sin(9 * physics.time())
        physics.data.mocap_pos[0, 2] += 0.01
        super().before_step(action, physics)

    def after_step(self, physics):
        physics.data.mocap_pos[0, 0] -= 0.02 + 0.1 * physics.data.qpos[0]


class DrawsItsModel(Arm):
    """Dynamics and looks, of which one drifts from episode to episode and one changes in each step."""

    def start(self, physics):
        model, draw = physics.model, self.random.uniform
        model.dof_damping[:] *= draw(0.5, 2.0)
        model.opt.gravity[:] = [draw(-1, 1), 0, -5]
        model.geom_size[1, 0] = draw(0.02, 0.1)
        model.geom_rgba[0, :3] = draw(0, 1, 3)
        model.mat_rgba[0, :3] = draw(0, 1, 3)
        model.vis.headlight.ambient[:] = draw(0, 1)

    def after_step(self, physics):
        physics.model.geom_rgba[0, 0] = physics.time() % 1


def own_step_and_reset():
    class Environment(control.Environment):
        def reset(self):
            first = super().reset()
            self.physics.data.qvel[0] = 1.0
            return first._replace(observation={"seen": self.physics.data.qvel.copy()})

        def step(self, action):
            found = super().step(0.5 * np.asarray(action))
            return found._replace(reward=(found.reward or 0) + 10, observation={"seen": self.physics.data.qpos.copy()})

    return arm(kind=Environment)


class EndedByPython(Arm):
    def start(self, physics):
        self.left = self.random.randint(5, 12)

    def after_step(self, physics):
        self.left -= 1

    def get_termination(self, physics):
        return 0.0 if self.left <= 0 else None


class ThreeActionsForTwoMotors(Arm):
    def action_spec(self, physics):
        return specs.BoundedArray((3,), float, [0, -2, -0.3], [3, 0.8, 0.1])

    def before_step(self, action, physics):
        physics.set_control(np.array(action) @ TRIPLE)


def odd_bounds():
    one = ARM.replace('"hinge" ctrlrange="-1 1"', '"hinge"')
    return arm(xml=one.replace('"wrist" ctrlrange="-1 1"', '"wrist" ctrlrange="-0.1 5"'))


def flat_torques():
    torques = having("Torques", get_observation=lambda self, physics: {"torque": physics.data.sensordata.copy()})
    return arm(torques(), flat_observation=True)


def odd_limit():
    return arm(time_limit=0.3, legacy_step=False)


def sleeping():
    return arm(xml=ARM.replace('<option timestep="0.01"/>', '<option timestep="0.01"><flag sleep="enable"/></option>'))


def muscles():
    act = '<general name="first" joint="hinge" dyntype="filter" dynprm="0.1" gainprm="2" ctrlrange="-1 1"/>'
    return arm(xml=ARM.replace('<motor name="first" joint="hinge" ctrlrange="-1 1"/>', act))


class Hills(Arm):
    def start(self, physics):
        physics.model.hfield_data[:] = self.random.uniform(0, 1, 120 * 120)


def hills(task=Hills):
    """Terrain of more numbers than a stored row has."""
    asset = '<hfield name="hills" nrow="120" ncol="120" size="2 2 .5 .1"/></asset>'
    ground = '<geom type="hfield" hfield="hills" pos="0 0 -.4"/></worldbody>'
    return arm(task(), xml=ARM.replace("</asset>", asset).replace("</worldbody>", ground))


class CountsEpisodes(Arm):
    episodes = 0

    def start(self, physics):
        self.episodes += 1
        physics.data.qvel[:] = self.episodes


class CountsLate(Arm):
    wins = 0

    def start(self, physics):
        physics.data.qpos[0] = self.wins

    def after_step(self, physics):
        self.wins += 0.43 < physics.data.time < 0.45  # after what the start's check sees
        super().after_step(physics)


def keeps_physics():
    environment = arm()
    environment.task.get_reward = lambda physics: float(environment.physics.data.qpos[0])
    return environment


# -- what is drawn elsewhere, and seeded for each episode -------------------------------------------


class DrawsElsewhereAtTheStart(Arm):
    def start(self, physics):
        physics.data.qpos[0] = np.random.uniform() + random.uniform(-1, 1)
        physics.data.qpos[1] = np.random.default_rng().uniform()


class GeneratorOfItsOwn(Arm):
    def __init__(self):
        super().__init__()
        self.generator = np.random.default_rng()

    def start(self, physics):
        physics.data.qpos[:] = self.generator.uniform(-1, 1, 2)

    def after_step(self, physics):
        physics.data.qvel[:] += self.generator.normal(size=2)


def drawn_model():
    rod = np.random.uniform(0.02, 0.08)
    return arm(xml=ARM.replace('size=".05" fromto', f'size="{rod}" fromto'))


# -- what is refused ---------------------------------------------------------------------------------


class NumpyInAStep(Arm):
    def after_step(self, physics):
        physics.data.qvel[0] += np.random.normal()


class NumpyInALateStep(Arm):
    def after_step(self, physics):
        physics.data.qvel[0] += np.random.normal() if physics.time() > 0.45 else 0


class NewGeneratorInAStep(Arm):
    def before_step(self, action, physics):
        super().before_step(action + np.random.default_rng().normal(size=2), physics)


class FixedGenerator(Arm):
    def __init__(self):
        super().__init__()
        self.generators = {"start": np.random.default_rng(0)}

    def start(self, physics):
        physics.data.qpos[:] = self.generators["start"].uniform(-1, 1, 2)


class GeneratorOfTheModule(Arm):
    def start(self, physics):
        physics.data.qpos[:] = MODULE_GENERATOR.uniform(-1, 1, 2)


def no_motor():
    start, end = ARM.index("<actuator>"), ARM.index("</mujoco>")  # and no sensor of them
    return arm(xml=ARM[:start] + ARM[end:])


def no_camera():
    return arm(xml=ARM.replace('<camera name="side" pos="0 -2 1" xyaxes="1 0 0 0 .4 1"/>', ""))


class Diverging(Arm):
    def after_step(self, physics):
        if physics.time() > 0.45:
            physics.data.qvel[0] = 1e12


def diverges():
    return arm(Diverging())


def diverges_quietly():
    class Environment(control.Environment):
        def step(self, action):
            with self.physics.suppress_physics_errors():
                return super().step(action)

    return arm(Diverging(), kind=Environment)


class LateChange(Arm):
    """It is undone before the episode ends."""

    def after_step(self, physics):
        physics.model.geom_rgba[0, 0] = 0.3 if 0.45 < physics.time() < 0.49 else 0


def other_models():
    return arm(xml=ARM.replace('<light pos="0 0 3"/>', '<light pos="0 0 3"/>' * np.random.randint(1, 100)))


@functools.cache
def one_environment():
    return arm()


@functools.cache
def the_physics():
    return mujoco.Physics.from_xml_string(ARM)


def one_physics():
    return control.Environment(the_physics(), Arm(), time_limit=0.5, control_timestep=0.02)


def one_model():
    physics = mujoco.Physics.from_model(the_physics().model)
    return control.Environment(physics, DrawsItsModel(), time_limit=0.5, control_timestep=0.02)


class PaintedAnew(Arm):
    def start(self, physics):
        physics.model.tex_data[:] = self.random.randint(256)


def restarts_itself():
    class Environment(control.Environment):
        def step(self, action):
            return super().step(action) if self.physics.time() < 0.1 else self.reset()

    return arm(kind=Environment)


def quake(after=0.45):
    class Quake(Hills):
        def after_step(self, physics):
            if physics.time() > after:
                physics.model.hfield_data[0] = physics.time()

    return hills(Quake)


def early_quake():
    return quake(0.0)
