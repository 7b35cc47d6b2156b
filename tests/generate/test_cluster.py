"""Releases made on many machines: parts that share nothing but a bucket, and a Ray cluster that loses a node."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen import files
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release, writer
from dmcvb_gen.dataset.manifest import local_manifest
from dmcvb_gen.dataset.writer import finish_release, start_release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import write_bytes
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.jobs import left_to_do, part_of
from dmcvb_gen.generate.plan import (
    _prepare_bucket,
    _refuse_altered_bucket,
    describe,
    finish,
    make_plan,
    prepare,
)
from dmcvb_gen.generate.progress import progress_of
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.generate.target import LOCK, Target, UploadQueue, staging_folder_of
from dmcvb_gen.parallel import Ray
from dmcvb_gen.spec import ANT_MAZE
from dmcvb_gen.storage.local import LocalStorage
from tests.conftest import TINY_MAZE, roll_out

WALKER = {"tasks": "walker-walk", "levels": "expert", "settings": ["none", "dynamic"], "episodes": 4}
MAZE = {"tasks": "ant-maze-empty7x7", "levels": "expert", "settings": "hidden", "episodes": 4}


def quick_recipe(*patterns, **changes):
    """Five-step episodes in shards of one, small pictures."""
    short = [pattern | {"episodes_per_shard": 1, "max_steps": 5} for pattern in patterns or (WALKER, MAZE)]
    fields = {"name": "quick", "seed": 2, "size": 8, "renderer": {"backend": "native"}, "subsets": short}
    return make_recipe(fields | changes)


@pytest.fixture(scope="module")
def recipe_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "quick.json"  # which is YAML, too
    path.write_text(json.dumps(quick_recipe().model_dump(mode="json", exclude_defaults=True)))
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same release, made in one folder by one process."""
    folder = tmp_path_factory.mktemp("whole") / "r"
    roll_out(quick_recipe(), folder)
    return folder


def digests(manifest):
    return {subset.name: subset.digest for subset in manifest.subsets}


def contents(folder):
    """Bytes of all files of a release by path, hidden ones apart."""
    paths = {path.relative_to(folder).as_posix(): path for path in Path(folder).rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in paths.items() if not Path(name).name.startswith(".")}


# -- parts and buckets ----------------------------------------------------------------------------


def test_parts_are_all_jobs_whatever_is_done(tmp_path):
    jobs = make_plan(quick_recipe(), tmp_path / "r").jobs
    parts = [part_of(jobs, (k, 3)) for k in (1, 2, 3)]
    assert sorted(map(str, sum(parts, ()))) == sorted(map(str, jobs)) and len(jobs) == 8
    name = jobs[0].subsets[0].name
    left = left_to_do(jobs, {name: {jobs[0].shard}})
    assert len(left) == 8 and name not in {record.name for record in left[0].subsets}
    with pytest.raises(StoreError, match="4/3"):
        part_of(jobs, (4, 3))


def test_a_bucket_ends_with_the_very_files_of_a_folder(whole, tmp_path):
    target = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    plan = prepare(make_plan(quick_recipe(), target))
    assert [job.inputs for job in plan.jobs] == [None] * 8  # workers need nothing but the bucket
    for command in (["verify"], ["fetch", "--out", str(tmp_path / "fetched")]):
        result = CliRunner().invoke(main, [command[0], f"file://{tmp_path}/bucket", *command[1:]])
        assert result.exit_code == 2 and "is not finished; finish it first: dmcvb-gen rollout --out" in result.output
    for _ in run_jobs(plan.jobs):
        pass
    assert finish(plan).complete and contents(tmp_path / "bucket") == contents(whole)
    assert not [path for path in (tmp_path / "scratch").rglob("*") if path.is_file()]
    again = make_plan(None, target)
    assert again.jobs == () and again.done == 12


def test_a_shard_made_twice_ends_in_the_same_bytes_and_other_bytes_are_refused(whole, tmp_path):
    plan = prepare(make_plan(quick_recipe(), tmp_path / "r"))
    job = plan.jobs[0]
    [first], [second] = run_jobs([job]), run_jobs([job])  # a retry beside a slow one
    assert first.commits == second.commits
    target, commit = Target.at(tmp_path / "r"), first.commits[0]
    other = commit.model_copy(update={"files": commit.files[:-1], "environment": {"cpu": "another one"}})
    with pytest.raises(StoreError, match="committed meanwhile with other bytes"):
        target.commit_shard(staging_folder_of(target).folder, other)


def test_versions_other_than_those_of_the_beginning_are_refused_unless_asked_for(tmp_path):
    plan = prepare(make_plan(quick_recipe(), tmp_path / "r"))
    manifest = json.loads((tmp_path / "r/manifest.json").read_text())
    manifest["environments"][0]["mujoco"] = "1.50"
    (tmp_path / "r/manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="begun with mujoco 1.50 .* --other-versions"):
        prepare(make_plan(None, tmp_path / "r"))
    assert (
        prepare(make_plan(None, tmp_path / "r"), other_versions=True).jobs
        == plan.jobs[:0] + make_plan(None, tmp_path / "r").jobs
    )


def test_progress_is_told_from_the_commit_records_alone(tmp_path):
    target = Target.at(tmp_path / "r")
    plan = prepare(make_plan(quick_recipe(), tmp_path / "r"))
    assert progress_of(target).done == 0 and progress_of(target).steps_per_second is None
    list(run_jobs(plan.jobs[1:3]))
    for number, path in enumerate(sorted((tmp_path / "r/commits").rglob("*.json"))):
        os.utime(path, (1000 + 10 * number, 1000 + 10 * number))
    found = progress_of(target)
    assert (found.done, found.total, found.late, found.steps) == (4, 12, 2, 20)
    assert found.steps_per_second == pytest.approx(15 / 30) and found.seconds_left == pytest.approx(8 * 5 / 0.5)


def test_what_waits_to_be_sent_takes_a_bounded_room():
    sender, waiting, most = UploadQueue(bound=25), [], [0]

    def send():
        time.sleep(0.02)
        waiting.pop()

    waits = []
    for _ in range(8):
        waiting.append(10)
        most[0] = max(most[0], sum(waiting))
        waits.append(sender.send(10, send))
    for wait in waits:
        wait()
    assert most[0] <= 30 and not waiting


def test_a_shard_that_scratch_cannot_hold_is_refused(tmp_path):
    target = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path, scratch_bytes=1000)
    plan = prepare(make_plan(quick_recipe(), target))
    with pytest.raises(StoreError, match="--scratch-size"):
        list(run_jobs(plan.jobs))


def test_a_release_grows_in_a_bucket_as_in_a_folder(tmp_path):
    def grow(place):
        for episodes, patterns in ((2, [WALKER]), (4, [WALKER, MAZE])):
            recipe = quick_recipe(*[pattern | {"episodes": episodes} for pattern in patterns])
            plan = prepare(make_plan(recipe, place))
            list(run_jobs(plan.jobs))
            manifest = finish(plan)
        return manifest

    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    grown = grow(bucket)
    assert grown.version == "1.1.0" and grown.complete and grow(tmp_path / "r").digest == grown.digest
    assert contents(tmp_path / "bucket") == contents(tmp_path / "r")
    assert open_release(f"file://{tmp_path}/bucket").manifest == grown
    with pytest.raises(StoreError, match="seed 2, asked for 4"):
        prepare(make_plan(quick_recipe(seed=4), bucket))


def test_finishing_a_bucket_keeps_what_another_machine_adds_meanwhile(tmp_path, monkeypatch):
    walker, maze = (pattern | {"episodes": 1, "levels": "random"} for pattern in (WALKER, MAZE))
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    plan, others = prepare(make_plan(quick_recipe(walker), bucket)), []
    list(run_jobs(plan.jobs))

    def grown_meanwhile(*arguments):
        if not others:
            others.append(prepare(make_plan(quick_recipe(walker, maze), bucket)))
        return finish_release(*arguments)

    monkeypatch.setattr("dmcvb_gen.generate.plan.finish_release", grown_meanwhile)
    assert len(finish(plan).subsets) == 3
    list(run_jobs(others[0].jobs))
    done = finish(others[0])
    assert done.complete and open_release(f"file://{tmp_path}/bucket").manifest == done


def test_two_who_begin_in_one_new_folder_both_stay(tmp_path, monkeypatch):
    walker, maze = (pattern | {"episodes": 1, "levels": "random"} for pattern in (WALKER, MAZE))
    first, second = (describe(quick_recipe(pattern))[0] for pattern in (walker, maze))
    other, write = threading.Thread(target=start_release, args=(tmp_path / "r", second)), writer.write_json_atomically

    def write_beside_another(path, value):
        if value.subsets == first.subsets:
            other.start()
            other.join(1)  # long enough to be done, if nothing held it
        write(path, value)

    monkeypatch.setattr(writer, "write_json_atomically", write_beside_another)
    start_release(tmp_path / "r", first)
    other.join()
    names = {record.name for record in local_manifest(tmp_path / "r").subsets}
    assert names == {record.name for record in (*first.subsets, *second.subsets)}


@pytest.mark.parametrize(
    "place,words", [("s3:/bucket/x", "did you mean s3://bucket/x"), ("memory://x", "lost when this process ends")]
)
def test_places_that_would_go_astray_are_refused(place, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StoreError, match=words):
        Target.at(place, scratch=tmp_path)
    assert not (tmp_path / "s3:").exists()


def test_growing_in_a_bucket_is_refused_where_something_is_damaged_and_goes_on_where_it_was_stopped(
    tmp_path, monkeypatch
):
    def grow(place, episodes):
        plan = prepare(make_plan(quick_recipe(WALKER | {"episodes": episodes}), place))
        list(run_jobs(plan.jobs))
        return finish(plan)

    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    grow(bucket, 2)
    grow(tmp_path / "r", 2)
    wanted = grow(tmp_path / "r", 4)
    path = next(tmp_path.glob("bucket/**/state/zarr.json"))
    before = path.read_bytes()
    path.write_bytes(before.replace(b'"zarr_format": 3', b'"zarr_format":  3'))
    with pytest.raises(StoreError, match="state/zarr.json.* is damaged"):
        grow(bucket, 4)
    path.write_bytes(before)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_before_manifest(patch, bucket)
        prepare(make_plan(quick_recipe(WALKER | {"episodes": 4}), bucket))
    assert path.read_bytes() != before
    assert grow(bucket, 4).digest == wanted.digest
    assert contents(tmp_path / "bucket") == contents(tmp_path / "r")


def stop_before_manifest(patch, bucket):
    """Interrupt whoever has written all but a bucket's manifest."""
    write = type(bucket.storage).write

    def written(storage, path, data):
        if path == "manifest.json":
            raise KeyboardInterrupt
        write(storage, path, data)

    patch.setattr(type(bucket.storage), "write", written)


def begin(place, episodes=2):
    """Prepare a release without images; nothing is rolled out."""
    return prepare(light_plan(place, episodes)).manifest


def light_plan(place, episodes=2):
    pattern = {"tasks": "walker-walk", "levels": "random", "settings": "none", "episodes": episodes}
    return make_plan(quick_recipe(pattern), place, pixels=False)


def arrays(folder):
    return {name: data for name, data in contents(folder).items() if name.endswith("zarr.json")}


def test_of_two_who_begin_in_one_new_bucket_with_other_settings_the_second_changes_nothing(tmp_path):
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    recipe = quick_recipe({"tasks": "walker-walk", "levels": "random", "settings": "none", "episodes": 2}, size=16)
    second = make_plan(recipe, bucket)  # when nothing is there yet
    begin(bucket)
    before = contents(tmp_path / "bucket")
    with pytest.raises(StoreError, match="size 8, asked for 16"):
        _prepare_bucket(second, bucket)
    assert contents(tmp_path / "bucket") == before


def test_a_bucket_grows_to_fewer_episodes_than_a_killed_grower_wanted(tmp_path, monkeypatch):
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    begin(bucket)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_before_manifest(patch, bucket)
        begin(bucket, 6)
    wide = next(tmp_path.glob("bucket/**/state/zarr.json"))
    assert json.loads(wide.read_bytes())["shape"][0] == 6
    wide.write_bytes(wide.read_bytes().replace(b"6,", b"2,", 1))  # killed before it wrote this one
    begin(bucket, 4)
    begin(tmp_path / "r")
    begin(tmp_path / "r", 4)
    assert arrays(tmp_path / "bucket") == arrays(tmp_path / "r")


def test_a_bucket_is_finished_as_it_was_before_a_killed_grower(tmp_path, monkeypatch):
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    plan = prepare(light_plan(bucket))
    list(run_jobs(plan.jobs))
    finish(plan)
    before = contents(tmp_path / "bucket")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_before_manifest(patch, bucket)
        begin(bucket, 6)
    assert contents(tmp_path / "bucket") != before
    finish(prepare(light_plan(bucket)))
    assert contents(tmp_path / "bucket") == before


def test_a_grower_of_a_bucket_that_comes_too_late_changes_nothing(tmp_path, monkeypatch):
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    begin(bucket)
    others = []

    def grown_meanwhile(*arguments):
        if not others:
            others.append(None)
            others.append(begin(bucket, 6))
            others.append(contents(tmp_path / "bucket"))
        return _refuse_altered_bucket(*arguments)

    monkeypatch.setattr("dmcvb_gen.generate.plan._refuse_altered_bucket", grown_meanwhile)
    with pytest.raises(StoreError, match="holds 6 episodes .* asked for 4"):
        begin(bucket, 4)
    assert contents(tmp_path / "bucket") == others[2] and bucket.manifest() == others[1]


class SlowStorage(LocalStorage):
    """A folder that is slow to change."""

    def _remove(self, path):
        time.sleep(0.4)
        super()._remove(path)

    def _write(self, path, data):
        time.sleep(0.4)
        super()._write(path, data)


def test_of_several_who_take_over_the_lock_of_a_killed_process_one_has_it_at_a_time(tmp_path, monkeypatch):
    for name, seconds in {"LOCK_SECONDS": 0.6, "LOCK_PAUSE": 1}.items():
        monkeypatch.setattr(f"dmcvb_gen.generate.target.{name}", seconds)
    (tmp_path / LOCK).write_text("of a killed process")
    holding, together = [], []

    def hold(storage):
        with replace(Target.at(f"file://{tmp_path}"), storage=storage).lock():
            holding.append(storage)
            together.append(len(holding))
            time.sleep(0.8)
            holding.remove(storage)

    storages = (kind(tmp_path, f"file://{tmp_path}") for kind in (SlowStorage, LocalStorage))
    threads = [threading.Thread(target=hold, args=(storage,)) for storage in storages]
    for thread in threads:
        thread.start()
        time.sleep(0.1)  # so that the slow one is the first to see that the lock is old, and the last to act on it
    for thread in threads:
        thread.join()
    assert together == [1, 1] and not (tmp_path / LOCK).exists()


def test_who_lost_the_lock_of_a_bucket_writes_no_manifest(tmp_path):
    target = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path)
    with pytest.raises(StoreError, match="took over .*bucket meanwhile; rerun"), target.lock() as lock:
        lock.check()
        target.storage.write(LOCK, b"of another process")
        lock.check()
    assert target.storage.read(LOCK) == b"of another process"


@pytest.mark.parametrize("damaged", [b"{", b"[]", b'{"consolidated_metadata": null}', b"\xff"])
def test_damaged_metadata_of_a_bucket_in_the_making_are_one_line(tmp_path, damaged):
    bucket = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    [record] = begin(bucket).subsets
    (tmp_path / f"bucket/{record.name}.zarr/zarr.json").write_bytes(damaged)
    with pytest.raises(StoreError, match="bucket/walker-walk/random/none.zarr/zarr.json is damaged; put it there"):
        bucket.bring_metadata(record, tmp_path / "staged")


def test_folders_left_before_a_restart_of_the_machine_are_of_no_running_process(tmp_path, monkeypatch):
    def start(boot, host="a" * 32):
        for name, text in {"BOOT": boot, "HOST": host}.items():
            (tmp_path / name).write_text(text)
            monkeypatch.setattr(files, name, tmp_path / name)
        monkeypatch.setattr(files, "HOST_NAMESPACE", os.readlink("/proc/self/ns/pid"))
        for known in (files._machine, files._host):
            known.cache_clear()

    def leave(name, host="a" * 32):
        start("the last start", host)
        with files.folder_in_the_making(tmp_path / "r", name) as folder:
            pass
        folder.mkdir()  # as if the machine had failed before it went
        return folder

    (tmp_path / "r").mkdir()
    try:
        mine, of_another_host = leave("shards"), leave("regenerate", "b" * 32)
        old = tmp_path / "r" / re.sub(r"\+[0-9a-f]+@", "@", mine.name)  # of a version that did not name the host
        old.mkdir()
        start("this start")
        assert files.others_at_work(tmp_path / "r") == [f"a process of machine {files._machine().rpartition('-')[0]}"]
        files.remove_partial(tmp_path / "r")
        assert {path.name for path in (tmp_path / "r").iterdir()} == {old.name, of_another_host.name}
        shutil.rmtree(of_another_host)
        start("the last start")
        assert files.others_at_work(tmp_path / "r") == []  # this process's own
    finally:
        for known in (files._machine, files._host):
            known.cache_clear()


def test_no_room_for_the_digests_of_a_bucket_is_one_line(tmp_path, monkeypatch):
    plan = prepare(make_plan(quick_recipe(), Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")))
    list(run_jobs(plan.jobs))

    def full(path, data):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("dmcvb_gen.generate.plan.write_bytes", full)
    with pytest.raises(StoreError, match="no room to write to .*scratch.*No space left"):
        finish(plan)


def test_many_verify_as_one(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "r")
    for path in sorted((tmp_path / "r").glob("*/*/*.zarr/reward/c/2/*")):
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    one, other = (
        CliRunner().invoke(main, ["verify", str(tmp_path / "r"), "--json", "--workers", count]) for count in "12"
    )
    assert one.exit_code == other.exit_code == 1 and json.loads(one.stdout) == json.loads(other.stdout)
    assert len(json.loads(one.stdout)["findings"]) == 3


BUCKET = ["rollout", "walker-walk", "--episodes", "2", "--max-steps", "3", "--size", "8", "--samples", "1", "--out"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--part", "3/2"], "K from 1 to N"),
        (["--part", "x"], "K from 1 to N"),
        (["--init", "--finish"], "one of"),
        (["--finish"], "holds no release"),
        (["--scratch-size", "much"], "--scratch-size"),
        (["--option", "secret=x"], "in the environment"),
    ],
)
def test_bad_requests_are_refused_and_leave_nothing(tmp_path, arguments, words):
    result = CliRunner().invoke(main, [*BUCKET, f"file://{tmp_path}/bucket", "--scratch", str(tmp_path), *arguments])
    assert result.exit_code == 2 and words in result.output + result.stderr
    assert not contents(tmp_path)


def test_another_release_or_other_files_in_the_bucket_are_refused(tmp_path):
    here = Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")
    prepare(make_plan(quick_recipe(), here))
    with pytest.raises(StoreError, match="seed 2, asked for 4"):
        prepare(make_plan(quick_recipe(seed=4), here))
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/thesis.tex").write_text("years of work")
    with pytest.raises(StoreError, match="other files.*thesis.tex"):
        prepare(make_plan(quick_recipe(), Target.at(f"file://{tmp_path}/thesis", scratch=tmp_path / "scratch")))


def test_nobody_at_the_address_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("s3fs")
    monkeypatch.setattr("dmcvb_gen.storage.base.PAUSE", 0.01)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "x")
    options = ["--option", "endpoint_url=http://127.0.0.1:9", "--option", "max_attempts=1"]
    result = CliRunner().invoke(main, [*BUCKET, "s3://bucket/x", "--scratch", str(tmp_path), *options[:2]])
    assert result.exit_code == 2 and result.stderr.startswith("error: ") and result.stderr.count("\n") == 1


# -- batch systems --------------------------------------------------------------------------------


def test_a_folder_is_listed_while_others_write_into_it(whole, tmp_path):
    name = next(path.relative_to(whole) for path in sorted((whole / "commits").rglob("*.json")))
    data, path, ended = (whole / name).read_bytes(), tmp_path / "r" / name, threading.Event()
    write_bytes(path, data)

    def write():
        while not ended.is_set():
            write_bytes(path, data)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(300):
            assert set(Target.at(tmp_path / "r").storage.list()) == {name.as_posix()}
    finally:
        ended.set()
        writer.join()


def test_the_slurm_script_does_parts_and_finishes(tmp_path, recipe_file):
    arguments = ["rollout", "--recipe", str(recipe_file), "--out", "s3://bucket/x", "--workers", "4"]
    script = CliRunner().invoke(main, [*arguments, "--slurm-script", "3"]).output
    assert "#SBATCH --array=1-3" in script and "#SBATCH --requeue" in script and "#SBATCH --cpus-per-task=4" in script
    (tmp_path / "job.sh").write_text(script)
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    for name in ("dmcvb-gen", "sbatch"):
        (bin_ / name).write_text(f'#!/bin/bash\necho {name} "$@" >> {tmp_path}/log\n')
    (bin_ / "squeue").write_text(f'#!/bin/bash\n[ "$2" = --name=dmcvb-gen-finish-7 ] && grep sbatch {tmp_path}/log\n')
    for path in bin_.iterdir():
        path.chmod(0o755)
    for task in (1, 2, 3, 1):  # the first one is requeued
        environment = os.environ | {"PATH": f"{bin_}:{os.environ['PATH']}", "SLURM_ARRAY_JOB_ID": "7"}
        environment["SLURM_ARRAY_TASK_ID"] = str(task)
        subprocess.run(["bash", str(tmp_path / "job.sh")], check=True, env=environment)
    called = (tmp_path / "log").read_text().splitlines()
    base = f"dmcvb-gen rollout --recipe {recipe_file} --out s3://bucket/x --workers 4"
    assert called[0] == f"{base} --init" and called[1].startswith("sbatch --dependency=afterok:7")
    assert called[1].endswith(f"--wrap={base} --finish")
    assert called[2:] == [*(f"{base} --part {task}/3" for task in (1, 2, 3)), f"{base} --init", f"{base} --part 1/3"]


def test_no_slurm_script_is_printed_for_what_each_task_would_refuse(tmp_path):
    for arguments in (
        ["walker-wlak"],
        ["walker-walk", "--distractor", "static", "--backgrounds", str(tmp_path / "no")],
        ["walker-walk", "--out", "s3:/bucket/x"],
        ["--out", str(tmp_path / "nothing")],
    ):
        result = CliRunner().invoke(main, ["rollout", "--out", "s3://bucket/x", *arguments, "--slurm-script", "3"])
        assert result.exit_code == 2 and "#SBATCH" not in result.output


# -- Ray ------------------------------------------------------------------------------------------


def test_an_address_where_no_cluster_answers_is_one_line(tmp_path):
    pytest.importorskip("ray")
    arguments = [
        *BUCKET,
        str(tmp_path / "r"),
        "--executor",
        "ray",
        "--ray-address",
        "127.0.0.1:9",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2 and re.search("error: no Ray cluster answers at 127.0.0.1:9", result.stderr)


@pytest.mark.slow
def test_a_ray_cluster_that_loses_a_node_and_gains_one_makes_the_same_release(whole, tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        lost = [cluster.add_node(num_cpus=1) for _ in range(2)][0]
        plan = prepare(make_plan(quick_recipe(), tmp_path / "r"))
        results = run_jobs(plan.jobs, Ray(cluster.address))
        next(results)
        cluster.remove_node(lost, allow_graceful=False)  # SIGKILL, whatever it is doing
        cluster.add_node(num_cpus=1)
        assert len(list(results)) == len(plan.jobs) - 1
    finally:
        cluster.shutdown()
    manifest, deadline = finish(plan), time.time() + 60
    while list((tmp_path / "r").glob(".*.partial")) and time.time() < deadline:
        time.sleep(1)  # workers of the lost node may take a moment to die; what they left goes with the next finish
        manifest = finish(plan)
    assert digests(manifest) == digests(open_release(whole).manifest)
    assert contents(tmp_path / "r") == contents(whole)
    assert {subset.family for subset in plan.manifest.subsets} >= {ANT_MAZE}


@pytest.mark.slow
def test_a_ray_cluster_paints_regenerates_and_repaints_as_one_process_does(tmp_path):
    ray = pytest.importorskip("ray")
    recipe = quick_recipe(WALKER | {"episodes": 2}, MAZE | {"episodes": 2, "tasks": TINY_MAZE, "levels": "random"})
    plan = prepare(make_plan(recipe, tmp_path / "light", pixels=False))
    list(run_jobs(plan.jobs))
    finish(plan)
    made = {}
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        for name, how in {"ray": ["--executor", "ray"], "here": []}.items():
            light = tmp_path / name / "light"
            shutil.copytree(tmp_path / "light", light)
            for command in (
                ["paint", light],
                ["regenerate", light, "--out", tmp_path / name / "again"],
                ["repaint", light, "--size", "12", "--out", tmp_path / name / "larger"],
            ):
                result = CliRunner().invoke(main, [str(word) for word in [*command, *how]])
                assert result.exit_code == 0, result.output
            for folder in ("light", "again", "larger"):
                made[name, folder] = contents(tmp_path / name / folder)
    finally:
        ray.shutdown()
    for folder in ("light", "again", "larger"):
        assert made["ray", folder] == made["here", folder], folder
    assert len(made["ray", "light"]) > len(contents(tmp_path / "light"))


@pytest.mark.slow
def test_a_ray_cluster_verifies_exports_and_validates_as_one_process_does(tmp_path):
    ray = pytest.importorskip("ray")
    few = {"levels": "random", "episodes": 2}
    roll_out(quick_recipe(WALKER | few | {"settings": "none"}, MAZE | few | {"tasks": TINY_MAZE}), tmp_path / "r")
    told = {}
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        for name, how in {"ray": ["--executor", "ray"], "here": []}.items():
            exported = tmp_path / name / "npz"
            validated = ["--agents", "state-bc", "--profile", "smoke", "--train-unsound", "--threads", "1"]
            for command in (
                ["verify", tmp_path / "r", "--json"],
                ["export", tmp_path / "r", "--to", "npz", "--out", exported],
                ["validate", tmp_path / "r", *validated, "--out", tmp_path / name / "report"],
            ):
                result = CliRunner().invoke(main, [str(word) for word in [*command, *how]])
                assert result.exit_code in (0, 1), result.output
                told[name, command[0]] = result.stdout if command[0] == "verify" else None
            told[name, "export"] = contents(exported)
            cells = json.loads((tmp_path / name / "report/report.json").read_text())["results"]
            told[name, "validate"] = [(cell["id"], cell["score"]["returns"]) for cell in cells]
    finally:
        ray.shutdown()
    for what in ("verify", "export", "validate"):
        assert told["ray", what] == told["here", what] and told["here", what], what


@pytest.mark.parametrize("task, other", [("walker-walk", "cheetah-run"), ("ant-maze-empty7x7", "ant-maze-easy7x7a")])
def test_finishing_does_not_pass_over_what_is_asked_for(tmp_path, task, other):
    def finishing(*request):
        words = [
            "rollout",
            *request,
            "--level",
            "random",
            "--max-steps",
            "5",
            "--no-pixels",
            "--out",
            str(tmp_path / "r"),
            "--finish",
        ]
        return CliRunner().invoke(main, words)

    made = {"levels": ["random"], "episodes": 2, "max_steps": 5, "pixels": False, "progress": False}
    dmcvb_gen.rollout(task, out=tmp_path / "r", **made)
    assert finishing(task, "--episodes", "2").exit_code == 0
    for request in ((other, "--episodes", "2"), (task, "--episodes", "4")):
        result = finishing(*request)
        assert result.exit_code == 2 and "--finish makes nothing; remove --finish" in result.output, result.output


def test_a_rollout_to_a_url_with_a_hash_sign_is_opened_there(tmp_path):
    made = {"levels": ["random"], "episodes": 1, "max_steps": 5, "pixels": False, "progress": False}
    release = dmcvb_gen.rollout("walker-walk", out=f"file://{tmp_path}/run#1", **made)
    assert list(release) == ["walker-walk/random/none"] and (tmp_path / "run#1").is_dir()


def test_folders_of_killed_processes_are_removed_by_the_next_ones(tmp_path):
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    scratch, release = tmp_path / "scratch/dmcvb-gen", tmp_path / "release"
    left = [scratch / ".metadata.OWNER.x8.partial", tmp_path / ".release-light.OWNER.x8.partial"]
    left = [path.with_name(path.name.replace("OWNER", f"{files._machine()}@{killed.pid}")) for path in left]
    for folder in left:
        (folder / "arrays").mkdir(parents=True)
    prepare(light_plan(Target.at(f"file://{tmp_path}/bucket", scratch=tmp_path / "scratch")))
    assert not left[0].exists()
    made = {"levels": ["random"], "episodes": 1, "max_steps": 5, "size": 16, "progress": False}
    dmcvb_gen.rollout("walker-walk", out=release, **made)
    dmcvb_gen.publish(release, f"file://{tmp_path}/there", pixels=False, progress=False)
    assert not list(tmp_path.rglob("*.partial"))
