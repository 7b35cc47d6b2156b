"""A table of MJCF models of a user's own, each as the renderer that is chosen for it draws it and as MuJoCo does."""

from __future__ import annotations

import copy
import logging
import re
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest

from dmcvb_gen.distractors import DistractorSetting, load_backgrounds
from dmcvb_gen.errors import DmcvbError, RenderingError
from dmcvb_gen.generate import renderer_choice as choice
from dmcvb_gen.generate.render import open_renderer
from dmcvb_gen.generate.renderer_choice import default_renderer
from dmcvb_gen.rendering import opengl, renderer_class
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task
from dmcvb_gen.tasks.environment import EnvironmentTask
from dmcvb_gen.tasks.own import mjcf_environment
from tests.conftest import posed
from tests.rendering.test_rendering import drawn_labels, frames_of, needs_opengl

SKY = '<texture type="skybox" builtin="gradient" rgb1=".4 .6 .8" rgb2="0 0 0" width="128" height="128"/>'
CHECKER = 'builtin="checker" rgb1=".2 .3 .8" rgb2=".9 .9 .2" width="64"'
SHAPES = """<mesh name="wedge" vertex="0 0 0 .5 0 0 0 .5 0 0 0 .5 -.3 -.3 .2"/>
<hfield name="hills" nrow="4" ncol="4" size=".5 .5 .3 .05" elevation="0 1 0 1 1 0 1 0 0 1 0 1 1 0 1 0"/>"""
MATERIALS = {
    "plain": '<material name="m" rgba=".8 .5 .3 1"/>',
    "flat": f'<texture name="t" type="2d" {CHECKER} height="64"/><material name="m" texture="t"/>',
    "cube": f'<texture name="t" type="cube" {CHECKER} height="384"/><material name="m" texture="t" texuniform="true"/>',
    "mirror": '<material name="m" rgba=".4 .5 .4 1" reflectance=".5"/>',
    "glowing": '<material name="m" rgba=".4 .5 .4 1" emission=".6"/>',
    "glass": '<material name="m" rgba=".4 .5 .4 .4"/>',
}
GEOMS = {
    "plane": 'type="plane" size=".5 .5 .1" pos="0 0 .1"',
    "sphere": 'type="sphere" size=".35"',
    "capsule": 'type="capsule" size=".2 .3"',
    "ellipsoid": 'type="ellipsoid" size=".4 .25 .3"',
    "cylinder": 'type="cylinder" size=".3 .3"',
    "box": 'type="box" size=".4 .25 .3"',
    "mesh": 'type="mesh" mesh="wedge"',
    "hfield": 'type="hfield" hfield="hills"',
}
LAMP_WITH = '<light pos=".5 -1 2" dir="-.2 .4 -1" {}/>'
LAMP = LAMP_WITH.format("")
FLOOR = '<geom type="plane" size="3 3 .1" pos="0 0 -.5" rgba=".4 .5 .4 1"/>'


def model(geom="box", material="plain", *, world=FLOOR, lamp=LAMP, visual="", camera="", sky=SKY, after=""):
    """The XML of a geom that turns (a plane does not), seen from above at an angle."""
    shape = f'<geom name="shape" {GEOMS[geom]} material="m" mass="1" contype="0" conaffinity="0"/>' if geom else ""
    still, turning = (shape, "") if geom == "plane" else ("", shape)
    return f"""<mujoco><visual>{visual}</visual><asset>{sky}{SHAPES}{MATERIALS[material]}</asset>
    <worldbody>{lamp}{world}{still}<camera name="view" pos="0 -1.6 1.2" xyaxes="1 0 0 0 .6 .8" {camera}/>
    <body name="moved"><joint name="turn" axis=".3 .2 1" damping=".1"/>{turning}
    <geom size=".05" mass=".1" contype="0" conaffinity="0" pos="0 0 .6"/></body></worldbody>
    <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator>{after}</mujoco>"""


def tendon(kind, sites='<site site="a"/><site site="b"/>'):
    """A tendon between two sites of the world."""
    ends = FLOOR + '<site name="a" pos="-.7 0 .2" size=".05"/><site name="b" pos=".7 .2 .2" size=".05"/>'
    spatial = f'<tendon><spatial width=".03" rgba=".9 .1 .1 1" {kind}>{sites}</spatial></tendon>'
    return model("cylinder", world=ends, after=spatial)


def flex(count, dimensions):
    """A cloth or a rope."""
    shape = f'dim="{dimensions}" count="{count}" spacing=".15 .15 .15" pos="0 0 .3" radius=".02"'
    inside = '<edge equality="true" damping=".1"/><contact contype="0" conaffinity="0"/>'
    return model(world=f'{FLOOR}<flexcomp name="f" type="grid" {shape} rgba=".2 .7 .4 1" mass="1">{inside}</flexcomp>')


SKIN = """<deformable><skin rgba=".8 .3 .3 1" vertex="0 0 0 .4 0 0 0 .4 0 0 0 .6" face="0 1 2 0 2 3 0 3 1 1 3 2"><bone
body="moved" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2 3" vertweight="1 1 1 1"/></skin></deformable>"""
DOT = '<geom type="box" size=".03 .03 .03" pos="{} {} -.4"/>'
GRID = "".join(DOT.format(x / 8 - 1, y / 8 - 1) for x in range(16) for y in range(16))
LOOKS = [(geom, look) for geom in GEOMS for look in ("plain", "flat", "cube")]
LOOKS += [(geom, look) for geom in ("plane", "box") for look in ("mirror", "glowing", "glass")]
MODELS = {f"{geom}, {look}": model(geom, look, world=FLOOR * (geom != "plane")) for geom, look in LOOKS}
MODELS |= {
    "plane above a plane": model("plane"),
    "infinite plane": model(world='<geom type="plane" size="0 0 .1" pos="0 0 -.5" rgba=".4 .5 .4 1"/>'),
    "no lamp": model(lamp=""),
    "no headlight": model(visual='<headlight active="0"/>'),
    "strong headlight": model(visual='<headlight ambient=".6 .6 .6" diffuse=".2 .2 .2" specular=".9 .9 .9"/>'),
    "sun": model(lamp='<light directional="true" pos="0 0 3" dir=".3 .4 -1" diffuse=".8 .7 .6"/>'),
    "no shadow": model(lamp=LAMP_WITH.format('castshadow="false"')),
    "attenuated lamp": model(lamp=LAMP_WITH.format('attenuation="1 .3 .1"')),
    "point lamp": model(lamp=LAMP_WITH.format('type="point"')),
    "narrow lamp": model(lamp=LAMP_WITH.format('cutoff="15" exponent="4"')),
    "two lamps": model(lamp=LAMP + '<light pos="-1 -1 2" dir=".4 .4 -1" diffuse=".4 .1 .1"/>'),
    "lamp that is off": model(lamp=LAMP_WITH.format('active="false"')),
    "tendon": tendon(""),
    "wrapped tendon": tendon("", '<site site="a"/><geom geom="shape"/><site site="b"/>'),
    "hanging tendon": tendon('range="0 2" limited="true"'),
    "sites": model(world=FLOOR + '<site type="box" size=".1 .2 .1" pos=".5 0 .4" rgba="0 1 0 1"/>'),
    "skin": model(after=SKIN),
    "cloth": flex("6 6 1", 2),
    "rope": flex("8 1 1", 1),
    "orthographic camera": model(camera='projection="orthographic" fovy="2"'),
    "camera with a sensor": model(camera='resolution="64 64" sensorsize=".01 .01" focal=".01 .01"'),
    "wide camera": model(camera='fovy="100"'),
    "many geoms": model(world=FLOOR + GRID),
    "no sky": model(sky=""),
}
NATIVE = {f"{geom}, plain" for geom in GEOMS if geom not in ("mesh", "hfield")} | {
    *("plane, flat", "plane, mirror", "plane, glass", "sphere, cube", "ellipsoid, cube", "no lamp", "no headlight"),
    *("strong headlight", "no shadow", "narrow lamp", "two lamps", "lamp that is off", "tendon", "sites"),
    *("wide camera", "no sky"),
}
"""Those that native draws."""


def task_of(tmp_path, xml, steps=8, **options):
    """A task of a user's own, and states of two episodes of it: (frame, physics)."""
    (tmp_path / "model.xml").write_text(xml)
    task = EnvironmentTask("own:model", lambda: mjcf_environment(tmp_path / "model.xml", lambda _: 0.0, **options))
    batch = task.batch(2)
    batch.reset([np.random.default_rng(seed) for seed in range(2)])
    for _ in range(steps):
        batch.step(np.ones((2, 1)))
    return task, batch.physics()


def labels_of(task, physics):
    return drawn_labels(task, DistractorSetting(), physics[None])


def drawn(name, task, physics, labels):
    """(frame, size, size, 3) float: pictures of a renderer."""
    renderer = renderer_class(name)(task, 64)
    pictures = renderer.render(physics, labels)[:, 0].astype(float)
    renderer.close()
    return pictures


def reference(task, physics, change=lambda model, data: None):
    """The same as `mujoco.Renderer` draws them; `change` sets the model of an episode."""
    pictures = []
    for row in physics:
        model = copy.copy(task.model)
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, row[: mujoco.mj_stateSize(model, task.physics_spec)], task.physics_spec)
        change(model, data)
        mujoco.mj_forward(model, data)
        with mujoco.Renderer(model, 64, 64) as renderer:
            renderer.update_scene(data, 0)
            pictures.append(renderer.render().astype(float))
    return np.stack(pictures)


@needs_opengl
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in {*NATIVE, "skin"} else pytest.mark.slow) for name in MODELS]
)
def test_the_chosen_renderer_draws_what_mujoco_draws(name, tmp_path):
    task, physics = task_of(tmp_path, MODELS[name])
    chosen = default_renderer(task)
    pictures = drawn(chosen, task, physics[:1], labels_of(task, physics[:1]))
    off = np.abs(pictures - reference(task, physics[:1]))[0].mean(axis=-1)
    assert (chosen == "native") == (name in NATIVE)
    if chosen == "opengl":
        assert off.max() <= 1
    else:
        assert off.mean() <= 3 and off.reshape(8, 8, 8, 8).mean(axis=(1, 3)).max() <= 25


@pytest.mark.slow_cases("humanoid-walk", "cheetah-run")
@needs_opengl
@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_opengl_without_distractors_is_mujocos_picture(task_id):
    task, _, physics, labels = frames_of(task_id, "none", 4)
    off = np.abs(drawn("opengl", task, physics, labels) - reference(task, physics)).max(axis=-1)
    assert (off > 2).mean() < 0.01  # labels are float32: a pixel on an edge may fall to the other side


def draw_looks(model, data):
    """Looks of an episode, as a function of its start."""
    angle = data.qpos[0]
    model.geom("shape").size[:] = 0.1 + 0.3 * angle
    model.mat("m").rgba[:3] = angle, 1 - angle, 0.5
    model.light("lamp").diffuse[:] = 1 - angle


def draw_episode(physics, random):
    physics.data.qpos[0] = random.uniform()
    draw_looks(physics.model._model, physics.data)


@pytest.mark.slow
@needs_opengl
def test_what_an_episode_draws_is_rendered_unless_the_distractor_replaces_it(tmp_path, caplog):
    named = model(lamp=LAMP_WITH.format('name="lamp"'))
    task, physics = task_of(tmp_path, named, steps=0, initialize=draw_episode)
    with caplog.at_level(logging.WARNING):
        assert default_renderer(task) == "opengl"
    [line] = caplog.messages
    assert "geom_size" in line and "mat_rgba" in line and "\n" not in line
    labels = labels_of(task, physics)
    np.testing.assert_array_equal(drawn("opengl", task, physics, labels), reference(task, physics, draw_looks))
    labels.material_rgb[1] = 0.1, 0.2, 0.9

    def recolored(model, data):
        draw_looks(model, data)
        if data.qpos[0] == physics[1, 1]:
            model.mat("m").rgba[:3] = 0.1, 0.2, 0.9

    np.testing.assert_array_equal(drawn("opengl", task, physics, labels), reference(task, physics, recolored))


@needs_opengl
def test_one_line_says_by_how_much_native_is_off(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(choice, "LARGEST_MEAN", 0.01)
    task, _ = task_of(tmp_path, model())
    assert default_renderer(task) == "opengl"
    [line] = caplog.messages
    assert re.search(r"own-model is rendered by opengl: native's pictures are \d\.\d grey levels off", line)


def test_without_opengl_one_line_says_that_nobody_compared(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(opengl, "_started", lambda: (None, "libEGL is missing"))
    task, _ = task_of(tmp_path, model())
    assert default_renderer(task) == "native"
    [line] = caplog.messages
    assert "without a comparison with MuJoCo's own renderer: libEGL is missing; install libegl1" in line
    with pytest.raises(RenderingError, match="'opengl' cannot start here: libEGL is missing; install"):
        renderer_class("opengl")(task, 64)


@needs_opengl
def test_a_renderer_that_closes_takes_nothing_from_another():
    task, _, physics, labels = frames_of("walker-walk", "none")
    first, second = (renderer_class("opengl")(task, 32) for _ in range(2))
    before = second.render(physics, labels)
    first.render(physics, labels)
    with ThreadPoolExecutor(1) as pool, pytest.raises(RenderingError, match="make an environment in the thread that"):
        pool.submit(first.render, physics, labels).result()
    del first
    np.testing.assert_array_equal(second.render(physics, labels), before)


@needs_opengl
def test_samples_are_those_that_opengl_gives():
    with pytest.raises(RenderingError, match=r"OpenGL gives \d+ samples a pixel here, not 3; ask for --samples"):
        renderer_class("opengl")(get_task("walker-walk"), 32, samples=3)


@needs_opengl
def test_a_video_needs_a_sky(tmp_path):
    task, physics = task_of(tmp_path, model(sky=""))
    with pytest.raises(RenderingError, match="has no sky to show a video on; add a texture"):
        open_renderer(task, DistractorSetting("dynamic"), "opengl", 64, None, "builtin", "train")
    with pytest.raises(RenderingError, match="has no sky to show a video on; add a texture"):
        labels = drawn_labels(task, DistractorSetting("dynamic"), physics[None])
        renderer_class("opengl")(task, 64, backgrounds=load_backgrounds()).render(physics, labels)


@pytest.mark.parametrize("difficulty", ["color0.2", "camera0.2-cue0.9", "color0.2-cue0.9"])
def test_a_model_without_materials_cannot_vary_its_colors(tmp_path, difficulty):
    task, physics = task_of(tmp_path, model(geom=None))
    with pytest.raises(DmcvbError, match="has no materials, so its colors cannot vary"):
        drawn_labels(task, DistractorSetting("dynamic", difficulty), physics[None])


@pytest.mark.parametrize(
    ("name", "share", "rtol"), [("native", 0.999, 1e-3), pytest.param("opengl", 0.97, 0.02, marks=needs_opengl)]
)
def test_every_pixel_shows_the_geom_that_mujocos_ray_meets(name, share, rtol, tmp_path):
    others = """<geom type="box" size=".2 .1 .3" pos=".5 .4 0" euler="20 30 0"/>
    <geom type="sphere" size=".2" pos="-.6 -.4 0"/><geom type="ellipsoid" size=".2 .1 .3" pos="-.6 .4 0"/>
    <geom type="capsule" size=".1 .2" pos=".6 -.4 0"/>"""
    task, physics = task_of(tmp_path, model("cylinder", world=FLOOR + others))
    renderer = renderer_class(name)(task, 64)
    found = renderer.render_labels(physics[:1], labels_of(task, physics[:1]))
    world, data = task.model, posed(task.model, physics[0], task.physics_spec)
    slope = np.tan(np.radians(world.cam_fovy[0]) / 2) * ((np.arange(64) + 0.5) / 32 - 1)
    met, meters = np.full((64, 64), -1), np.zeros((64, 64))
    for row, column in np.ndindex(64, 64):
        ray, geom = data.cam_xmat[0].reshape(3, 3) @ [slope[column], -slope[row], -1], np.zeros(1, np.int32)
        meters[row, column] = mujoco.mj_ray(world, data, data.cam_xpos[0], ray, None, 1, -1, geom)
        met[row, column] = geom[0]
    renderer.close()
    same = found["segmentation"][0, 0] == met
    assert same.mean() > share and len(np.unique(met)) >= 7
    seen = same & (met >= 0)
    close = np.isclose(found["depth"][0, 0][seen], meters[seen], rtol=rtol)
    assert close.mean() > share and (found["depth"][0, 0][met < 0] == 0).mean() > share
