"""Ant mazes against dm_control's composer environment, brute-force distances and hand-made layouts."""

import itertools

import labmaze
import numpy as np
import pytest
from dm_control import composer, mjcf
from dm_control.locomotion.arenas import mazes
from dm_control.locomotion.props import target_sphere
from dm_control.locomotion.tasks import random_goal_maze
from dm_control.locomotion.walkers import ant
from labmaze import assets
from scipy import ndimage, sparse

from dmcvb_gen.errors import LayoutError
from dmcvb_gen.tasks import get_task, typed_task
from dmcvb_gen.tasks.ant_maze import ANT_MAZE_TASKS, LAYOUTS, fixed_pairs
from dmcvb_gen.tasks.ant_maze.arena import WALL_HEIGHT, look_numbers
from dmcvb_gen.tasks.ant_maze.distance import PIXELS, blend, floor_of, geodesic_field, look_up, saturated_field
from dmcvb_gen.tasks.ant_maze.layouts import CELL, get_layout, make_layout
from dmcvb_gen.tasks.ant_maze.task import BEHAVIOUR_FIELDS, FIELDS
from dmcvb_gen.tasks.ant_maze.waypoints import headings
from tests.conftest import TINY_MAZE

GOAL_RADIUS, GOAL_HEIGHT = 0.5, 1.0
"""The released goal (SPEC, section 3), written here once more."""
BEHAVIOUR_ENDS = np.cumsum([FIELDS[name] for name in BEHAVIOUR_FIELDS])[:-1]


def composer_environment(layout, goal):
    """dm_control's own environment of a layout, its goal at (x, y)."""
    maze = labmaze.FixedMazeWithRandomGoals(entity_layer=layout.entity_layer, num_spawns=1, num_objects=1)
    arena = mazes.MazeWithTargets(maze=maze, xy_scale=CELL, z_height=WALL_HEIGHT)
    walker = ant.Ant()
    sphere = target_sphere.TargetSphere(radius=GOAL_RADIUS, height_above_ground=GOAL_HEIGHT)
    endless = dict(contact_termination=False, aliveness_threshold=-2)
    task = random_goal_maze.RepeatSingleGoalMaze(walker, arena, target=sphere, **endless)
    for observable in task.observables.values():
        if "camera" in str(type(observable)).lower():
            observable.enabled = False
    environment = composer.Environment(task, time_limit=60, random_state=0)

    def place(random_state):
        task._maze_arena.regenerate()
        mjcf.get_attachment_frame(sphere.mjcf_model).pos = [*goal, 0]

    task.initialize_episode_mjcf = place
    environment.reset()
    sphere.reset(environment.physics)  # dm_control's own spawn may lie on the goal
    return environment, sphere


WALKER_FIELDS = [name for name in FIELDS if "target" not in name and name != "walker_position"]


def throw(batch, rng):
    """Throw the first ant at its goal in the middle of the maze."""
    angle, away, goal = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.9), np.array([0.3, -0.2])
    direction = np.array([np.cos(angle), np.sin(angle)])
    batch._mocap[0, 0, :2] = goal
    batch._qpos[0, :2] = goal + away * direction
    batch._qvel[0, :2] = -rng.uniform(2, 6) * direction
    batch._refresh(np.array([0]))
    return batch.state()


THROWN = [pytest.param("empty7x7", seed, "thrown", 15, marks=pytest.mark.slow) for seed in (0, 2, 3, 4)]


@pytest.mark.slow_cases("easy7x7c-1-extreme-150", "medium7x7a-0-random-150")
@pytest.mark.parametrize(
    ("layout", "seed", "kind", "steps"),
    [("medium7x7a", 0, "random", 150), ("easy7x7c", 1, "extreme", 150), ("empty7x7", 2, "zero", 60), *THROWN],
)
def test_agrees_with_dm_control(layout, seed, kind, steps):
    """Physics and observations equal dm_control's over an episode; both sides end at the same control step."""
    task, rng = get_task(f"ant-maze-{layout}"), np.random.default_rng(seed)
    batch = task.batch(2)
    state = batch.reset([np.random.default_rng([seed, i]) for i in range(2)])
    if kind == "thrown":
        state = throw(batch, rng)
    environment, sphere = composer_environment(task.layout, batch.goal()[0, :2])
    physics = environment.physics
    with physics.reset_context():
        physics.data.qpos[:] = batch._qpos[0]
        physics.data.qvel[:] = batch._qvel[0]
    slices = task.state_slices
    for _ in range(steps):
        for name in WALKER_FIELDS:
            observable = getattr(environment.task._walker.observables, name)
            value = np.ravel(observable.observation_callable(physics)()).astype(float)
            value = value > 1e-3 if name == "sensors_touch" else value
            largest = max(1.0, np.abs(value).max())
            np.testing.assert_allclose(state[0, slices[name]], value, rtol=0, atol=1e-12 * largest, err_msg=name)
        ours = {name: state[0, part] for name, part in slices.items()}
        torso = physics.bind(environment.task._walker.root_body)
        np.testing.assert_array_equal(ours["walker_position"], torso.xpos)
        vector = physics.bind(sphere.geom).xpos - torso.xpos
        np.testing.assert_allclose(ours["target_vector"], vector, atol=1e-12)
        assert ours["target_position"][2] == GOAL_HEIGHT
        to_egocentric = environment.task._walker.transform_vec_to_egocentric_frame
        # As released: the goal geom's own position in its body, (0, 0, 1), taken for one of the world.
        local = physics.bind(sphere.geom).pos
        ego = to_egocentric(physics, local - torso.xpos)
        np.testing.assert_allclose(ours["egocentric_target_vector"], ego, atol=1e-12)
        seen = dict(zip(BEHAVIOUR_FIELDS, np.split(batch.behaviour_observation()[0], BEHAVIOUR_ENDS), strict=True))
        for name, value in ours.items():  # policies see parts of the state, but true vectors
            if name in seen and name != "egocentric_target_vector":
                np.testing.assert_array_equal(seen[name], value.astype(np.float32))
        np.testing.assert_allclose(seen["egocentric_target_vector"], to_egocentric(physics, vector), atol=1e-5)
        action = {"extreme": rng.choice([-1.0, 1.0], 8), "zero": np.zeros(8)}.get(kind, rng.uniform(-1, 1, 8))
        result = batch.step(np.stack([action, -action]))
        state = result.state
        for _ in range(2):
            if environment.step(action).last():
                break
        np.testing.assert_array_equal(batch._qpos[0], physics.data.qpos)
        assert bool(result.terminated[0]) == bool(sphere.activated) == state[0, slices["target_activated"]]
        if sphere.activated:
            break
    assert bool(sphere.activated) == (kind == "thrown")


def test_starts_and_goals():
    """Spawns cover all free cells within their noise, goals too, never the same cell; yaw is uniform."""
    task = get_task("ant-maze-medium7x7b")
    layout, count = task.layout, 400
    batch = task.batch(count)
    state = batch.reset([np.random.default_rng([5, i]) for i in range(count)])
    slices = task.state_slices
    start, goal = state[:, slices["walker_position"]][:, :2], state[:, slices["target_position"]][:, :2]
    for positions, noise in ((start, 0.25), (goal, 0.5)):
        cells = np.rint(layout.grid(positions)).astype(int)
        assert set(map(tuple, cells.tolist())) == set(layout.free)
        off = np.abs(positions - layout.world(cells))
        assert off.max() <= noise + 1e-9 and off.max() > 0.9 * noise
    assert (np.rint(layout.grid(start)) != np.rint(layout.grid(goal))).any(axis=1).all()
    height = batch._qpos[:, 2]
    assert -0.25 <= height.min() < -0.23 and 0.23 < height.max() <= 0.25 and (batch._qpos[:, 7:] == 0).all()
    assert task.max_steps == 600 and task.evaluation_steps == 1000
    yaw = 2 * np.arctan2(batch._qpos[:, 6], batch._qpos[:, 3])
    counts = np.histogram(yaw % (2 * np.pi), 8, (0, 2 * np.pi))[0]
    assert counts.min() > 25
    assert ((batch.distance() >= 0) & (batch.distance() / batch._largest <= 1)).all()


def test_speed_map_and_largest_distance_are_the_released_ones():
    layout = get_layout("medium7x7a")
    long_wall = floor_of(get_layout("empty7x7"))[1][35, 10:17]
    np.testing.assert_allclose(long_wall, [0.13, 0.31, 0.50, 0.70, 0.90, 1, 1], atol=5e-3)
    assert any(abs(saturated_field(layout, cell).largest - 18.50) < 5e-3 for cell in layout.free)


def test_distance_to_target_is_the_rewards_distance():
    """d of the state, in meters along the way, over its maximum is minus the reward of a control step."""
    task = get_task("ant-maze-medium7x7a")
    batch = task.batch(6)
    state = batch.reset([np.random.default_rng(i) for i in range(6)])
    slices = task.state_slices
    for number in range(6):
        goal, start = (state[number, slices[name]][:2] for name in ("target_position", "walker_position"))
        field = saturated_field(task.layout, tuple(np.rint(task.layout.grid(goal)).astype(int).tolist()))
        row, column = np.round((task.layout.grid(start) + 0.5) * 10 - 1).astype(int)
        distance = state[number, slices["distance_to_target"]][0]
        assert distance == field.values[row, column] >= 0
        assert -batch._control_reward()[number] == distance / field.largest
    apart = np.linalg.norm(state[:, slices["target_vector"]], axis=1)
    assert (state[:, slices["distance_to_target"]][:, 0] > apart + 0.5).any()  # around walls


def test_every_texture_of_a_style_has_the_same_chance():
    task = get_task("ant-maze-empty7x7")
    textures = (assets.get_wall_texture_paths, assets.get_floor_texture_paths)
    counts = {style: [len(paths(f"style_{style:02}")) for paths in textures] for style in range(1, 6)}
    looks = {style: look_numbers(style) for style in range(1, 6)}
    assert task.styles("train") == tuple(looks[style] for style in (2, 3, 4, 5)) and task.styles("val") == (looks[1],)
    assert [len(looks[style]) for style in range(1, 6)] == [48, 35, 49, 36, 16]
    every = [look for style in range(1, 6) for look in looks[style]]
    assert len(set(every)) == len(every)
    faces = [task.model.geom(name).id for name in ("wall*_0_texturing_pos_z", "floor_0")]
    for style in range(1, 6):
        pairs = {tuple(task.style_geom_matid(look)[faces]) for look in looks[style]}
        assert len(pairs) == len(looks[style])
        walls, floors = (set(values) for values in zip(*pairs, strict=True))
        assert [len(walls), len(floors)] == counts[style]


def test_fixed_pairs():
    layout = get_layout("easy7x7b")
    pairs = fixed_pairs(layout, 5, seed=3)
    assert pairs == fixed_pairs(layout, 5, seed=3) != fixed_pairs(layout, 5, seed=4)
    assert len(set(pairs)) == 5 and all(start != goal for start, goal in pairs)
    cells = len(layout.free)
    assert len(set(fixed_pairs(layout, cells * (cells - 1), 0))) == cells * (cells - 1)
    with pytest.raises(LayoutError, match="fixed goals"):
        fixed_pairs(layout, cells * (cells - 1) + 1, 0)
    for count in (1, 2, 4):
        assert fixed_pairs(layout, count, seed=3) == pairs[:count]  # pair k does not depend on how many are asked for
    with pytest.raises(LayoutError, match="start"):
        get_task("ant-maze-easy7x7b").batch(1).reset_fixed([np.random.default_rng(0)], [((0, 0), (1, 1))])


# -- distances ------------------------------------------------------------------------------------


def shortest_paths(layout, goal, fine=10):
    """Shortest paths on a grid with 32 directions, meters; never through a wall."""
    floor = np.kron(~layout.walls, np.ones((fine, fine), bool))  # with walls around it
    pixels, (r, c) = np.arange(floor.size).reshape(floor.shape), np.nonzero(floor)
    between = np.delete(np.arange(0.5, 37) / 37, 18)  # never on a pixel's border; half-way is looked at apart
    edges = []
    for a, b in itertools.product(range(-4, 5), repeat=2):
        if np.gcd(a, b) != 1:
            continue
        way = floor[np.rint(r[:, None] + a * between).astype(int), np.rint(c[:, None] + b * between).astype(int)]
        free = floor[r + a, c + b] & way.all(axis=1)
        if a % 2 and b % 2:  # half-way lies where four pixels meet: no way between walls that touch there
            r0, c0 = r + a // 2, c + b // 2
            free &= (floor[r0, c0] | floor[r0 + 1, c0 + 1]) & (floor[r0, c0 + 1] | floor[r0 + 1, c0])
        edges.append([pixels[r, c][free], pixels[r + a, c + b][free], np.full(free.sum(), np.hypot(a, b))])
    start, end, length = np.concatenate(edges, axis=1)
    graph = sparse.coo_array((length, (start.astype(int), end.astype(int))), shape=(floor.size, floor.size)).tocsr()
    place = ((layout.grid(goal) + 0.5) * fine).astype(int)
    first = np.linalg.norm(layout.world((place + 0.5) / fine - 0.5) - goal)
    away = sparse.csgraph.dijkstra(graph, indices=pixels[tuple(place)]).reshape(floor.shape)
    return np.where(floor, first + CELL / fine * away, np.nan)


MAZES = {
    "easy": LAYOUTS["easy7x7a"],
    "medium": LAYOUTS["medium7x7b"],
    "walls that touch at a corner": "*****/*...*/*.*.*/**..*/*****",
    "corridor": "****/*..*/****",
}


@pytest.mark.parametrize("name", MAZES)
def test_geodesic_field_is_the_shortest_path(name):
    layout, rng = make_layout("random", MAZES[name]), np.random.default_rng(0)
    goal = layout.world(layout.free[rng.integers(len(layout.free))]) + rng.uniform(-0.5, 0.5, 2)
    field = geodesic_field(layout, goal)
    brute = shortest_paths(layout, goal)
    floor = np.isfinite(brute)
    # Fast marching is exact to a pixel or so; the grid's 32 directions are within 1 %.
    assert np.abs(field.values[floor] - brute[floor]).max() <= 1.5 * CELL / PIXELS + 0.05 * brute[floor].max()
    assert np.isfinite(field.values).all() and np.isclose(field.largest, field.values[floor].max())


def test_geodesic_distances_are_blended_between_pixels_and_saturated_ones_are_the_pixels():
    """Outside of the maze they are those of its edge."""
    layout, rng = get_layout("easy7x7a"), np.random.default_rng(0)
    values, place = rng.random((PIXELS * 7, PIXELS * 7)), rng.uniform(-20, 90, (40, 2))  # pixels; centers are half-way
    positions, stack = layout.world(place / PIXELS - 0.5), np.repeat(values[None], 40, axis=0)
    blended = ndimage.map_coordinates(values, place.T - 0.5, order=1, mode="nearest")
    np.testing.assert_allclose(blend(layout, stack, positions), blended, atol=1e-9)
    row, column = np.clip(np.rint(place - 1).astype(int), 0, PIXELS * 7 - 1).T
    np.testing.assert_array_equal(look_up(layout, stack, positions), values[row, column])


@pytest.mark.parametrize("task_id", ANT_MAZE_TASKS)
def test_headings_lead_to_the_goal_clear_of_walls(task_id):
    layout = get_task(task_id).layout
    rng = np.random.default_rng(0)
    positions = layout.world(np.repeat(layout.free, 2, axis=0)) + rng.uniform(-0.9, 0.9, (2 * len(layout.free), 2))
    goals = np.tile(layout.world(layout.free[0]) + [0.3, -0.4], (len(positions), 1))
    floor = np.kron(~layout.walls, np.ones((PIXELS, PIXELS), bool))
    clear = ndimage.distance_transform_edt(floor) * CELL / PIXELS
    for number in range(400):
        vector = headings(layout, positions, goals, 2.0)
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        assert np.isfinite(vector).all() and (length < 2.0 * 2**0.5 + CELL).all()
        positions = positions + vector / np.maximum(length, 1e-9) * np.minimum(length, 0.15)
        pixel = ((layout.grid(positions) + 0.5) * PIXELS).astype(int)
        assert (clear[pixel[:, 0], pixel[:, 1]] > (0.4 if number > 10 else 0)).all()
    assert (np.linalg.norm(positions - goals, axis=1) < GOAL_RADIUS).all()


# -- layouts --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("*****\n*   *\n** **", "hole"),
        ("*****\n* * *\n*****", "cannot be reached"),
        ("*****\n*   *\n****", "cells, others"),
        ("*****\n* x *\n*****", "'x'"),
        ("***\n***\n***", "two floor cells"),
        ("", "1 x 0"),
    ],
)
def test_bad_layouts(text, message):
    with pytest.raises(LayoutError, match=message):
        make_layout("mine", text)


def test_own_layout(tmp_path):
    path = tmp_path / "my maze.txt"
    path.write_text("******\n*    *\n* ** *\n*    *\n******\n\n")
    task = get_task(typed_task(path))
    assert task.id.startswith("ant-maze-my_maze:") and task.layout.shape == (5, 6)
    state = task.batch(1).reset([np.random.default_rng(0)])
    assert state.shape == (1, 167)


@pytest.mark.parametrize("name", ["ant-maze-empty7x7", TINY_MAZE])
def test_simulations_hold_no_textures_and_all_else_that_painters_see(name):
    task = get_task(name)
    bare, whole = task.model, task.picture_model
    assert bare.nbuffer < 1_000_000 and whole.ntexdata > 100_000_000
    compared = 0
    for field in dir(whole):
        value = getattr(whole, field)
        if isinstance(value, np.ndarray) and not field.startswith(("_", "tex_", "name", "path", "mat_texid")):
            np.testing.assert_array_equal(getattr(bare, field), value, err_msg=field)
            compared += 1
    assert compared > 300
    names = [[model.geom(i).name for i in range(model.ngeom)] for model in (bare, whole)]
    materials = [[model.mat(i).name for i in range(model.nmat)] for model in (bare, whole)]
    assert names[0] == names[1] and materials[0] == materials[1]
