"""Environments: Gymnasium's checker passes; physics, rewards and pictures are those of the tasks and renderers."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.loaders.envs import FIXED_GOALS, DistractedEnv, DistractedVectorEnv
from dmcvb_gen.loaders.register import MAZES, SUITE, TASKS, environments
from dmcvb_gen.spec import DISTRACTOR_KINDS as SETTINGS
from dmcvb_gen.tasks import ANT_MAZE_TASKS, LOCOMOTION_TASKS, get_task, suite_ids
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from tests.conftest import TINY_MAZE, python, stack_channels

SMALL = dict(size=16)


def test_every_task_and_distractor_is_registered():
    assert TASKS == LOCOMOTION_TASKS and MAZES == ANT_MAZE_TASKS
    assert set(SUITE) < set(suite_ids()) and not set(SUITE) & set(TASKS)
    assert len(environments()) == (len(TASKS) + len(SUITE)) * len(SETTINGS) + 3 * len(MAZES)
    assert set(environments()) <= set(gymnasium.registry)


@pytest.mark.parametrize("task", SUITE)
def test_a_suite_task_is_made_by_its_name(task):
    env = gymnasium.make(f"dmcvb_gen/{task}-dynamic-v0", **SMALL)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    observation, reward, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation) and np.isfinite(reward)
    env.close()


def test_importing_the_package_is_enough():
    python("import dmcvb_gen, gymnasium; gymnasium.spec('dmcvb_gen/walker-walk-none-v0')")


@pytest.mark.slow_cases("dmcvb_gen/walker-walk-dynamic-v0")
@pytest.mark.parametrize("name", [f"dmcvb_gen/{task}-{s}-v0" for task, s in zip(TASKS, SETTINGS[::-1], strict=True)])
def test_gymnasiums_checker_passes(name):
    env = gymnasium.make(name, render_mode="rgb_array", **SMALL)
    check_env(env.unwrapped, skip_render_check=False)
    assert env.metadata["render_fps"] in (20, 50)
    env.close()


def test_states_and_rewards_are_the_tasks_own():
    env, task = gymnasium.make("dmcvb_gen/cheetah-run-static-v0", max_steps=50, **SMALL), get_task("cheetah-run")
    observation, _ = env.reset(seed=4)
    batch = task.batch(1)
    batch.set_physics(env.unwrapped._stage.batch.physics())
    rng = np.random.default_rng(0)
    for step in range(50):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        result = batch.step(action[None])
        assert reward == result.reward[0] and not terminated and truncated == (step == 49)
        np.testing.assert_array_equal(observation["state"], result.state[0].astype(np.float32))


def test_a_vector_environment_has_the_episodes_of_single_ones():
    vector = gymnasium.make_vec("dmcvb_gen/walker-walk-dynamic-v0", num_envs=3, **SMALL)
    observations, _ = vector.reset(seed=10)
    singles = [DistractedEnv("walker-walk", "dynamic", **SMALL) for _ in range(3)]
    for i, env in enumerate(singles):
        first, _ = env.reset(seed=10 + i)
        np.testing.assert_array_equal(observations["pixels"][i], first["pixels"])
    actions = np.random.default_rng(1).uniform(-1, 1, (5, 3, 6)).astype(np.float32)
    for action in actions:
        observations, rewards, *_ = vector.step(action)
        assert vector.observation_space.contains(observations)
        for i, env in enumerate(singles):
            one, reward, *_ = env.step(action[i])
            assert rewards[i] == reward
            np.testing.assert_array_equal(observations["state"][i], one["state"])
            np.testing.assert_array_equal(observations["pixels"][i], one["pixels"])
    assert len({observations["pixels"][i].tobytes() for i in range(3)}) == 3


def test_ended_episodes_restart_at_the_next_step_without_a_reward():
    vector = gymnasium.make_vec("dmcvb_gen/walker-walk-none-v0", num_envs=2, **SMALL)
    vector.reset(seed=0)
    vector.unwrapped._stage.frame[:] = [499, 10]
    actions = np.zeros((2, 6), np.float32)
    _, _, _, truncated, _ = vector.step(actions)
    assert list(truncated) == [True, False]
    _, rewards, terminated, truncated, _ = vector.step(actions)
    assert list(vector.unwrapped._stage.frame) == [0, 12] and not truncated.any() and not terminated.any()
    assert rewards[0] == 0 and rewards[1] > 0


def test_seeds_decide_everything_and_later_episodes_differ():
    env = DistractedEnv("walker-walk", "dynamic", **SMALL)
    first, second = env.reset(seed=1)[0], env.reset()[0]
    assert (first["pixels"] != second["pixels"]).any() and (first["state"] != second["state"]).any()
    again, second_again = env.reset(seed=1)[0], env.reset()[0]
    np.testing.assert_array_equal(first["pixels"], again["pixels"])
    np.testing.assert_array_equal(second["pixels"], second_again["pixels"])


def test_pictures_are_those_that_the_store_has_for_the_same_physics_and_labels(small_release):
    env = DistractedEnv("walker-walk", "none", **SMALL, renderer="native")  # as the release was painted
    env.reset(seed=0)
    episode = Release.open(small_release)["walker-walk/random/none"].episode(0)
    for step in (0, 250, 500):
        env._stage.state = env._stage.batch.set_physics(episode["physics"][step : step + 1])
        np.testing.assert_array_equal(env._stage.observe()["pixels"][0], episode["pixels"][step])


def test_fixed_mazes_go_round_the_fixed_pairs_and_hide_the_goal():
    maze, views = "ant-maze-empty7x7", ["top"]
    env = gymnasium.make(f"dmcvb_gen/{maze}-fixed-v0", views=views, goal_seed=3, size=48)
    task = get_task(maze)
    pairs, cells = fixed_pairs(task.layout, FIXED_GOALS, 3), []
    for _ in range(FIXED_GOALS + 1):
        observation, info = env.reset(seed=5 if not cells else None)
        fields = [task.state_slices[name] for name in ("walker_position", "target_position")]
        places = (observation["state"][field][:2] for field in fields)
        cells.append(tuple(tuple(int(x) for x in np.rint(task.layout.grid(place[None])[0])) for place in places))
        assert pairs[info["goal_pair"]] == cells[-1]
    assert cells == [*pairs, pairs[0]]
    env.unwrapped._stage.pictures = env.unwrapped._stage.pictures.__class__(("top",), hide_goal=False)
    assert (env.unwrapped._stage.observe()["pixels"][0] != observation["pixels"]).any()  # it was hidden
    vector = gymnasium.make_vec(f"dmcvb_gen/{maze}-fixed-v0", 2, goal_pair=1, goal_seed=3, views=views, **SMALL)
    states, told = vector.reset(seed=0)
    assert told["goal_pair"].tolist() == [1, 1] and told["_goal_pair"].all()
    for state in states["state"]:
        goal = task.layout.grid(state[task.state_slices["target_position"]][None, :2])[0]
        assert tuple(int(x) for x in np.rint(goal)) == pairs[1][1]
    assert DistractedEnv(maze, "fixed", goal_pair=3, views=views, **SMALL).reset(seed=0)[1] == {"goal_pair": 3}


@pytest.mark.slow_cases("walker-walk-dynamic")
@pytest.mark.parametrize("name", ["walker-walk-dynamic", "ant-maze-empty7x7-hidden"])
def test_stacks_hold_frames_as_the_readers_have_them(name):
    plain, env = (gymnasium.make(f"dmcvb_gen/{name}-v0", stack=stack, **SMALL) for stack in (None, 3))
    vector = gymnasium.make_vec(f"dmcvb_gen/{name}-v0", num_envs=2, stack=3, **SMALL)
    views = len(plain.unwrapped.task.views)
    frames = [plain.reset(seed=1)[0]["pixels"]]
    found, many = env.reset(seed=1)[0], vector.reset(seed=[1, 7])[0]
    for step in range(4):
        stack = np.stack([frames[max(step - back, 0)].reshape(16, 16, views, 3) for back in (2, 1, 0)])
        expected = stack_channels(np.moveaxis(stack, 3, 1))
        assert env.observation_space.contains(found) and vector.observation_space.contains(many)
        np.testing.assert_array_equal(found["pixels"], expected)
        np.testing.assert_array_equal(many["pixels"][0], expected)
        action = np.random.default_rng(step).uniform(-1, 1, plain.action_space.shape).astype(np.float32)
        frames.append(plain.step(action)[0]["pixels"])
        found, many = env.step(action)[0], vector.step(np.stack([action, action]))[0]
    vector.unwrapped._stage.frame[1] = vector.unwrapped._stage.max_steps - 1
    for _ in range(2):
        many = vector.step(np.zeros((2, *action.shape), np.float32))[0]
    parts = many["pixels"].reshape(2, 3, -1, 16, 16)
    assert (parts[1] == parts[1, :1]).all() and not (parts[0] == parts[0, :1]).all()  # a new episode began in place 1


@pytest.mark.parametrize("task", ["walker-walk", TINY_MAZE])
@pytest.mark.parametrize("modalities", ["depth", ["depth", "segmentation"]])
def test_observations_have_the_modalities_that_are_named(task, modalities):
    env = DistractedEnv(task, modalities=modalities, **SMALL)
    assert env.observation_space.keys() == {"pixels", "state", *([modalities] if modalities == "depth" else modalities)}
    assert env.observation_space.contains(env.reset(seed=0)[0])


MAZE = "ant-maze-empty7x7"
MISTAKES = [
    (("walker-walk", "static_harsh"), {}, "hard"),
    ((MAZE, "dynamic"), {}, "hidden"),
    ((MAZE, "visible"), {"views": ["behind"]}, "egocentric"),
    (("walker-walk",), {"size": 2}, "8 to 1024"),
    (("walker-walk",), {"render_mode": "human"}, "rgb_array"),
    (("walker-walk",), {"split": "test"}, "split is 'test'.*'val' or 'train'"),
    (("walker-walk",), {"siz": 16}, "siz is 16: Unexpected keyword argument"),
    (("walker-walk", "none"), {"backgrounds": "videos"}, "backgrounds has no effect.*remove backgrounds"),
    ((MAZE, "visible"), {"goal_pair": 0}, "no effect.*remove goal_pair"),
    (("walker-walk",), {"max_steps": 0}, "max_steps is 0"),
    ((MAZE, "fixed"), {"goal_pair": -1}, "goal_pair is -1"),
    ((MAZE, "fixed"), {"goal_pair": 7, "fixed_goals": 3}, "goal_pair is 7; give 0 to 2"),
    ((MAZE, "visible"), {"views": ()}, "views is empty"),
    (("walker-walk",), {"modalities": "flow"}, "has no flow"),
    (("lqr-lqr_2_1",), {}, "has transparent bodies, which 'native' does not paint"),
    (("dog-walk",), {}, "has geoms of type mesh, .* does not paint; use renderer opengl"),
]


@pytest.mark.parametrize("names, options, words", MISTAKES)
def test_mistakes_are_answered_in_a_line(names, options, words):
    with pytest.raises(DmcvbError, match=words) as caught:
        DistractedEnv(*names, **options)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("task", ["cheetah-run", TINY_MAZE])
def test_wrong_steps_and_seeds_are_refused_in_a_line(task):
    env, vector = DistractedEnv(task, max_steps=1, **SMALL), DistractedVectorEnv(2, task, **SMALL)
    size = env.action_space.shape[0]

    def refused(words, call, *given, **more):
        with pytest.raises(DmcvbError, match=words):
            call(*given, **more)

    refused("call reset", env.step, np.zeros(size))
    refused("at least 1", DistractedVectorEnv, 0, task)
    refused("3 seeds are given for 2 environments", vector.reset, seed=[1, 2, 3])
    refused("leave reset_mask out", vector.reset, options={"reset_mask": np.ones(2, bool)})
    env.reset(seed=0)
    vector.reset(seed=np.int64(1))
    vector.reset(seed=np.array([1, 2]))
    refused(rf"shape \(1, {size + 1}\); .* takes shape \(1, {size}\)", env.step, np.zeros(size + 1))
    refused(rf"takes shape \(2, {size}\)", vector.step, np.zeros((3, size)))
    refused("NaN or infinite", env.step, np.full(size, np.nan))
    refused("NaN or infinite", vector.step, np.full((2, size), np.inf))
    assert env.step(np.zeros(size))[3]
    refused("after the end of the episode", env.step, np.zeros(size))
    env.reset()
    assert env.step(np.zeros(size))[3]
