"""The one process pool: results as they come, progress, and what happens when something dies."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor

import pytest

from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.parallel import in_order, open_pool
from dmcvb_gen.parallel.base import IN_FLIGHT
from tests.conftest import wait


def square(number, tick):
    tick(number)
    return number * number


def fail(number, tick):
    raise UnknownNameError("level", "exprt", ("expert", "medium"))


class Two(Exception):
    """An error that pickles and cannot be made again, as people write them."""

    def __init__(self, a, b):
        super().__init__(a)


def fail_oddly(number, tick):
    raise Two("x\ny", "z")


def die(number, tick):
    os.kill(os.getpid(), signal.SIGKILL)


def ended(pids):
    return not any(os.path.exists(f"/proc/{pid}") for pid in pids)


def threads(number, tick):
    import torch

    return torch.get_num_threads(), os.getpid()


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_gives_its_result_and_its_progress(workers):
    ticks = []
    assert in_order(square, range(7), workers, ticks.append) == [number**2 for number in range(7)]
    assert sorted(ticks) == list(range(7))


@pytest.mark.parametrize("workers", [1, 2])
def test_results_may_ask_for_more_work(workers):
    with open_pool(workers) as pool:
        pool.submit("first", square, 3)
        seen = []
        for key, value in pool.results():
            seen.append((key, value))
            if key == "first":
                pool.submit("second", square, value)
    assert seen == [("first", 9), ("second", 81)]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_work_arrives_as_it_was_raised(workers):
    with pytest.raises(UnknownNameError, match="Did you mean 'expert'"):
        in_order(fail, [1, 2], workers)


def test_an_error_of_other_code_is_told_with_where_it_was():
    with pytest.raises(RuntimeError, match="^a worker failed: Two: x y") as caught:
        in_order(fail_oddly, [1, 2], 2)
    assert "in fail_oddly" in "".join(caught.value.__notes__)


def test_a_worker_that_dies_while_the_next_one_starts_is_said(monkeypatch):
    spawn = ProcessPoolExecutor._spawn_process

    def spawn_late(executor):
        if executor._processes:
            time.sleep(5)  # the first worker has died by then
        spawn(executor)

    monkeypatch.setattr(ProcessPoolExecutor, "_spawn_process", spawn_late)
    with pytest.raises(StoreError, match="killed .*; finished shards are saved.* fewer --workers than 2"):
        in_order(die, [1, 2], 2)


def test_what_is_handed_out_is_bounded():
    with open_pool(2) as pool:
        for number in range(50):
            pool.submit(number, square, number)
        results = pool.results()
        next(results)
        assert len(pool._running) <= 2 * IN_FLIGHT
        assert len(list(results)) == 49


@pytest.mark.slow
def test_workers_have_the_threads_that_they_were_given_and_end_with_the_pool():
    found = in_order(threads, [1, 2], 2)
    assert {count for count, _ in found} == {1}
    assert wait(lambda: ended(pid for _, pid in found))


PARENT = """
import os, signal, sys, time
from dmcvb_gen.parallel import in_order

def announce(number, tick):
    open(sys.argv[1] + f"/{os.getpid()}", "w").close()
    time.sleep(120)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a script runs in the background
    in_order(announce, [1, 2], 2)
"""


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(stop, tmp_path, tmp_path_factory):
    script = tmp_path_factory.mktemp("script") / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script), str(tmp_path)])
    assert wait(lambda: len(list(tmp_path.iterdir())) == 2)
    parent.send_signal(stop)
    parent.wait(timeout=60)  # the workers would sleep for two minutes
    assert wait(lambda: ended(path.name for path in tmp_path.iterdir()))


GUARDLESS = """
from dmcvb_gen.parallel import in_order
import helper

print("began")
print(in_order(helper.double, [1, 2, 3], 2))
"""


def test_a_script_without_a_main_guard_is_run_once(tmp_path):
    (tmp_path / "helper.py").write_text("def double(number, tick):\n    return 2 * number\n")
    (tmp_path / "script.py").write_text(GUARDLESS)
    done = subprocess.run([sys.executable, "script.py"], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.split("\n")[:2] == ["began", "[2, 4, 6]"] and done.returncode == 0, done.stderr
