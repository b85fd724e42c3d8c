"""Trials: one rendering each, disturbed at one or more random moments. Each returns its record."""

import random
import signal
import time
from collections.abc import Callable

import psutil

from benchmarks.kill.rendering import Record, Rendering, Undisturbed, files_of, finished, phase
from benchmarks.ray_cluster import LocalCluster

_AGAIN = 0.7
"""Probability that the resumed run, or the one that continues, is disturbed, too."""
_MOST_KILLED = 3
"""Largest number of workers or nodes killed in one run: a trajectory that is lost four times counts as failed."""


def killed_parent(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to the command, whose two workers end with it; resume, again and again."""
    return _chain(out, whole, draw, ("--workers", "2"), _killed)


def interrupted(out: str, whole: Undisturbed, draw: random.Random, options: tuple[str, ...]) -> Record:
    """Ctrl-C: time until the command and all its processes have ended; resume, again and again."""
    return _chain(out, whole, draw, options, _interrupted)


def _chain(
    out: str,
    whole: Undisturbed,
    draw: random.Random,
    options: tuple[str, ...],
    disturb: Callable[[Rendering], Record],
) -> Record:
    moments: list[Record] = []
    while not moments or (moments[-1]["disturbed"] and draw.random() < _AGAIN):
        run = Rendering(out, *options)
        whole.moment(draw, resumed=bool(moments)).wait(run)
        moments.append(disturb(run))
    return {"moments": moments, **finished(out, whole, len(moments), *options)}


def killed_worker(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to one of two workers, up to three times; the command continues."""

    def kill(run: Rendering) -> bool:
        workers = run.workers()
        try:
            if workers:
                draw.choice(workers).kill()
        except psutil.NoSuchProcess:
            return False
        return bool(workers)

    return _continues(Rendering(out, "--workers", "2"), whole, draw, kill)


def killed_node(out: str, whole: Undisturbed, draw: random.Random, cluster: LocalCluster) -> Record:
    """SIGKILL to all processes of one of two Ray nodes, up to three times; another joins up to three seconds later."""

    def kill(run: Rendering) -> bool:
        if not run.runs:
            return False
        cluster.kill(draw.randrange(len(cluster.nodes)))
        time.sleep(draw.uniform(0, 3))
        cluster.add()
        return True

    options = ("--executor", "ray", "--address", cluster.address, "--workers", "2")
    return _continues(Rendering(out, *options), whole, draw, kill)


def _continues(run: Rendering, whole: Undisturbed, draw: random.Random, kill: Callable[[Rendering], bool]) -> Record:
    moments: list[Record] = []
    while not moments or (run.runs and len(moments) < _MOST_KILLED and draw.random() < _AGAIN):
        whole.moment(draw, resumed=False).wait(run)
        moments.append({"moment_s": run.age_s, "phase": phase(run.out)})
        moments[-1]["disturbed"] = kill(run)
    code = run.wait()
    if code:
        return {"moments": moments, "code": code, "stderr": run.stderr[-1000:], **finished(run.out, whole, 1)}
    return {"moments": moments, "attempts": 1, "identical": files_of(run.out) == whole.files}


def killed_shard(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to one of two shards while the other continues; then both again, and `--finish`, which is killed, too."""
    runs = [Rendering(out, "--shard", f"{number}/2", "--workers", "1") for number in (1, 2)]
    whole.moment(draw, resumed=False).wait(runs[0])
    moments = [_killed(runs[0])]
    codes = [run.wait() for run in runs[1:]]
    codes += [Rendering(out, "--shard", f"{number}/2", "--workers", "1").wait() for number in (2, 1)]
    finish = Rendering(out, "--finish")
    # Most of its time are imports.
    _sleep(finish, draw.uniform(whole.seconds["start"] / 2, whole.seconds["start"] + whole.seconds["rendered"]))
    moments.append(_killed(finish))
    return {"moments": moments, "codes": codes, **finished(out, whole, 2, "--finish")}


def killed(run: Rendering, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to a command at a random moment."""
    whole.moment(draw, resumed=False).wait(run)
    return _killed(run)


def _killed(run: Rendering) -> Record:
    """SIGKILL to a command; waits until its workers have ended, too."""
    record: Record = {"moment_s": run.age_s, "phase": phase(run.out)}
    below = run.below()
    record["disturbed"] = run.send(signal.SIGKILL)
    run.wait()
    return {**record, "orphans": _wait(below, 30)}


def _interrupted(run: Rendering) -> Record:
    """Ctrl-C to a command; waits until its processes have ended, too."""
    record: Record = {"moment_s": run.age_s, "phase": phase(run.out)}
    below, asked_s = run.below(), time.monotonic()
    if not run.send(signal.SIGINT):
        return {**record, "disturbed": False}
    code = run.wait()
    _wait(below, 60)
    record |= {"seconds": time.monotonic() - asked_s, "disturbed": code != 0}
    lines = [line for line in run.stderr.splitlines() if line and "frames" not in line and "stopping after" not in line]
    one_line = code == 0 or (code == 130 and len(lines) == 1 and lines[0].endswith("the same command again to resume"))
    return {**record, "one_line": one_line, **({} if one_line else {"code": code, "stderr": run.stderr[-1500:]})}


def _wait(processes: list[psutil.Process], longest_s: float) -> int:
    """Wait until processes have ended; returns the number of those that run on. Zombies have ended."""
    end_s = time.monotonic() + longest_s
    while (n_running := sum(map(_runs, processes))) and time.monotonic() < end_s:
        time.sleep(0.05)
    return n_running


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _sleep(run: Rendering, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while run.runs and time.monotonic() < end_s:
        time.sleep(0.01)
