"""Faults: commands killed at random moments, on a full disk, and with damaged files, go on to the same bits.

    python -m benchmarks faults --count 20
    python -m benchmarks faults --commands run --kinds kills --count 5 --seed 3

`run`, `reconstruct`, `sweep` and `tune` work on a scene of 80 splats. Each is first run unbroken, twice. *Kills*:
SIGKILL at random moments, again and again in one folder, until the command ends by itself. *Full disk*: no file may
grow beyond a random size (RLIMIT_FSIZE); the command must end with its one line and exit code 2, and go on once there
is room. *Damage*: files of its folder are cut, flipped, emptied or removed; the command must make the same results
again, or refuse in one line and make them with `--overwrite`. Same seed, same moments.
"""

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w

from benchmarks.common.command import start_worker
from benchmarks.common.pages import head, row

SECONDS = 1800.0  # for one command, which takes a few, and a minute to compile
LEAST_BYTES = 60.0  # of the limit to a file
FRAMES, VALUES, STEPS = 5, 5, 8


class Command(NamedTuple):
    """A command, and the files that must come out the same."""

    words: tuple[str, ...]  # file names are those of `write_inputs`
    compared: tuple[str, ...]  # patterns in its folder


COMMANDS = {
    "run": Command(
        ("run", "scene.toml"), ("states/[0-9]*.npz", "states/particles.npz", "labels.npz", "video.mp4", "*.png")
    ),
    "reconstruct": Command(
        ("reconstruct", "transforms.json", "--steps", "1500", "--splats", "12", "--sh-degree", "0"), ("gaussians.ply",)
    ),
    "sweep": Command(("sweep", "study.toml"), ("rows/*.npz", "table.csv", "best.json")),
    "tune": Command(("tune", "study.toml"), ("history.npz", "best.json")),
}


def write_inputs(folder: Path) -> None:
    """A ball of 80 splats, a scene that throws it, a study of it, and two photos."""
    from pigjax import io
    from pigjax.splat import Gaussians

    rng = np.random.default_rng(0)
    out = rng.normal(size=(80, 3))
    points = 0.2 * out / np.linalg.norm(out, axis=1, keepdims=True) + [0, 0, 0.3]
    parts = points, np.full((80, 3), np.log(0.02)), np.tile([1.0, 0, 0, 0], (80, 1)), np.full(80, 3.0)
    io.save_ply(folder / "cloud.ply", Gaussians(*(np.float32(v) for v in (*parts, rng.uniform(-1, 1, (80, 1, 3))))))
    scene = {
        "input": {"gaussians": "cloud.ply"},
        "simulation": {"dx": 0.1, "frames": FRAMES, "fps": 30.0, "particles_per_cell": 2},
        "objects": {"ball": {"id": 1, "material": "jelly", "young": 4000.0, "velocity": [0.5, 0.0, -1.0]}},
        "planes": {"floor": {"point": [0, 0, 0.04], "normal": [0, 0, 1], "friction": 0.3}},
        "camera": {"width": 24, "height": 20, "target": [0, 0, 0.3], "radius": 2.0},
    }
    study = {
        "scene": "scene.toml",
        "objective": {"function": "aim", "options": {"object": "ball", "target": [0.2, 0.1, 0.35]}},
        "parameters": {"objects.ball.young": {"low": 2000.0, "high": 8000.0, "count": VALUES, "scale": "log"}},
        "sweep": {"of": "loss", "batch": 1},
        "tune": {"method": "adam", "rate": 0.1, "steps": STEPS},
        "overrides": {"simulation.frames": 1},
    }
    (folder / "scene.toml").write_text(tomli_w.dumps(scene))
    (folder / "study.toml").write_text(tomli_w.dumps(study))
    frames = []
    for k, x in enumerate((-0.2, 0.2, 0.0)):
        pose = np.eye(4)
        pose[:3, 3] = x, 0.0, 2.0
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
        io.write_image(folder / f"images/{k}.png", rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    lens = {"fl_x": 20, "fl_y": 20, "cx": 8, "cy": 6, "w": 16, "h": 12}
    io.write_json(folder / "transforms.json", {**lens, "frames": frames})


class Ended(NamedTuple):
    """How a command ended."""

    code: int  # exit code; minus the signal
    errors: str
    seconds: float

    def clean(self) -> bool:
        """Whether it told one error of one line, and no trace."""
        told = [line for line in self.errors.splitlines() if line.startswith("error: ")]
        return self.code in (2, 3) and len(told) == 1 and "Traceback" not in self.errors


class Runner:
    """A process that has imported pigjax and computed nothing; each command is a fork of it, sparing the import."""

    def __init__(self, inputs: Path, cache: Path):
        """Start it.

        Args:
            inputs: of `write_inputs`.
            cache: of compiled programs.
        """
        settings = {**os.environ, "PIGJAX_COMPILE_CACHE": str(cache), "PYTHONWARNINGS": "ignore"}
        for name in ("JAX_COMPILATION_CACHE_DIR", "CI"):
            settings.pop(name, None)
        self.inputs = inputs
        self.process = start_worker("faults", inputs, env=settings, stdin=subprocess.PIPE)
        self._answer()

    def run(self, command: Command, out: Path, *more: str, kill_after: float | None = None, largest: int = 0) -> Ended:
        """Run a command, perhaps killed after some seconds, perhaps with files of at most so many bytes."""
        words = [str(self.inputs / command.words[1]) if k == 1 else word for k, word in enumerate(command.words)]
        begun = time.monotonic()
        pid = int(self._ask("\t".join([str(largest), *words, "-o", str(out), "--quiet", *more])))
        limit = SECONDS if kill_after is None else kill_after
        while not (done := self._ask("?")):
            if time.monotonic() - begun > limit:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                done = self._ask("!")
                break
            time.sleep(0.005)
        return Ended(int(done), (self.inputs / "stderr").read_text(errors="replace"), time.monotonic() - begun)

    def _ask(self, line: str) -> str:
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> str:
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("the process that runs the commands has ended")
        return line.strip()

    def __enter__(self) -> "Runner":
        """Return itself."""
        return self

    def __exit__(self, *_) -> None:
        """End the process."""
        self.process.stdin.close()
        self.process.wait()


def worker(inputs: str) -> None:
    """The process that forks: a line starts a command and gets its number; "?" and "!" get its exit code."""
    import resource

    import pigjax
    from pigjax.cli import main

    pid = 0
    print(pigjax.__version__, flush=True)
    for line in sys.stdin:
        text = line.rstrip("\n")
        if text in ("?", "!"):
            found, status = os.waitpid(pid, os.WNOHANG if text == "?" else 0)
            print(os.waitstatus_to_exitcode(status) if found else "", flush=True)
            continue
        largest, *words = text.split("\t")
        pid = os.fork()
        if pid == 0:
            errors = os.open(Path(inputs) / "stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(errors, 2)
            os.dup2(errors, 1)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            if int(largest):
                resource.setrlimit(resource.RLIMIT_FSIZE, (int(largest),) * 2)
            sys.argv = ["pigjax", *words]
            code = 0
            try:
                main()
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
            except BaseException:
                traceback.print_exc()
                code = 1
            sys.stderr.flush()
            os._exit(code)
        print(pid, flush=True)


def results_of(command: Command, out: Path) -> dict[str, str]:
    """Digest of each file that counts; of arrays, without the form of their archive."""
    found = {}
    for pattern in command.compared:
        for path in sorted(out.glob(pattern)):
            if path.suffix == ".npz":
                with np.load(path) as arrays:
                    content = b"".join(name.encode() + arrays[name].tobytes() for name in sorted(arrays.files))
            else:
                content = path.read_bytes()
            found[str(path.relative_to(out))] = hashlib.sha256(content).hexdigest()
    return found


class Study:
    """Trials of one command against its unbroken results."""

    def __init__(self, name: str, runner: Runner, folder: Path, seed: int):
        """Run it unbroken, once to compile and once to time it."""
        self.name, self.command, self.runner, self.folder = name, COMMANDS[name], runner, folder / name
        self.rng = np.random.default_rng([seed, *name.encode()])
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []
        first, again = (self.folder / part for part in ("first", "whole"))
        for out in (first, again):
            self.unbroken = runner.run(self.command, out)
            if self.unbroken.code:
                raise RuntimeError(f"{name} fails unbroken, code {self.unbroken.code}: {self.unbroken.errors[-2000:]}")
        self.whole, self.results = again, results_of(self.command, again)
        self._note("unbroken", first)

    def kills(self, count: int) -> None:
        """Killed `count` times, on average thrice before it may end."""
        out, left = self.folder / "killed", count
        while left:
            ended = self.runner.run(self.command, out, kill_after=self.rng.uniform(0.1, 1) * self.unbroken.seconds)
            if ended.code == -signal.SIGKILL:
                left -= 1
                self.counts["killed"] += 1
            elif ended.code:
                self._fault("killed", f"ended with {ended.code}: {ended.errors[-300:]}")
            if ended.code != -signal.SIGKILL or self.rng.random() < 0.3 or not left:
                self._complete("killed", out)
                shutil.rmtree(out, ignore_errors=True)

    def disks(self, count: int) -> None:
        """Refused by a full disk `count` times."""
        largest = max(path.stat().st_size for path in self.whole.rglob("*") if path.is_file())
        for _ in range(count):
            out = self.folder / "full"
            limit = int(LEAST_BYTES * (largest / LEAST_BYTES) ** self.rng.random())
            ended = self.runner.run(self.command, out, largest=limit)
            self.counts["full disk"] += 1
            if ended.code and not ended.clean():
                self._fault("full disk", f"at {limit} bytes a file it ended with {ended.code}: {ended.errors[-400:]}")
            self._complete("full disk", out)
            shutil.rmtree(out, ignore_errors=True)

    def damages(self, count: int) -> None:
        """A file damaged `count` times, of a finished or of a killed command."""
        for _ in range(count):
            out = self.folder / "damaged"
            if self.rng.random() < 0.5:
                shutil.copytree(self.whole, out)
            else:
                self.runner.run(self.command, out, kill_after=self.rng.uniform(0.5, 1) * self.unbroken.seconds)
            files = sorted(path for path in out.rglob("*") if path.is_file()) if out.exists() else []
            if files:
                path = files[self.rng.integers(len(files))]
                told = f"{self._damage(path)} {path.relative_to(out)}"
                self.counts["damaged"] += 1
                self._complete(f"damaged ({told})", out)
            shutil.rmtree(out, ignore_errors=True)

    def _damage(self, path: Path) -> str:
        content = path.read_bytes()
        kind = ("cut", "flipped", "emptied", "removed")[self.rng.integers(4)]
        if kind == "removed" or not content:
            path.unlink()
            return "removed"
        at = int(self.rng.integers(len(content)))
        changed = {"cut": content[:at], "flipped": bytearray(content), "emptied": b""}[kind]
        if kind == "flipped":
            changed[at] ^= 1 << int(self.rng.integers(8))
        path.write_bytes(changed)
        return kind

    def _complete(self, what: str, out: Path) -> None:
        """Let the command end, and compare."""
        ended = self.runner.run(self.command, out)
        if ended.clean() and ended.code == 2 and "--overwrite" in ended.errors:
            self.counts["refused"] += 1
            ended = self.runner.run(self.command, out, "--overwrite")
        if ended.code:
            self._fault(what, f"does not go on, code {ended.code}: {ended.errors[-400:]}")
            return
        self._note(what, out)

    def _note(self, what: str, out: Path) -> None:
        found = results_of(self.command, out)
        other = [name for name in {**self.results, **found} if self.results.get(name) != found.get(name)]
        self.counts["other" if other else "same"] += 1
        if other:
            self._fault(what, f"other bits than unbroken: {', '.join(other)}")

    def _fault(self, what: str, told: str) -> None:
        self.faults.append(f"{self.name}, {what}: {told}")
        print(self.faults[-1], file=sys.stderr, flush=True)


KINDS = {"kills": "killed", "disks": "full disk", "damages": "damaged"}


def faults(commands, kinds, count, seed=0, tell=lambda name, counts: None):
    """Trials of each command; its counts by name, and the faults.

    Args:
        commands: names of `COMMANDS`.
        kinds: names of methods of `Study`: kills, disks, damages.
        count: of each kind; of disks and damages half as many.
        seed: of moments and damages.
        tell: gets the counts of each command that is done.
    """
    counts, bad = {}, []
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        write_inputs(inputs)
        with Runner(inputs, Path(folder) / "cache") as runner:
            for name in commands:
                study = Study(name, runner, Path(folder), seed)
                for kind in kinds:
                    getattr(study, kind)(count if kind == "kills" else -(-count // 2))
                counts[name], bad = study.counts, bad + study.faults
                tell(name, study.counts)
    return counts, bad


def table(options, kinds):
    """Print the counts of each command; end with 1 where one did not come out the same."""
    begun = time.monotonic()

    def tell(name, found):
        print(row(name, *(found[kind] for kind in KINDS.values()), found["refused"], found["same"], found["other"]))

    print(head("command", *KINDS.values(), "refused, then replaced", "ended the same", "ended otherwise"))
    _, bad = faults(options.commands, kinds, options.count, options.seed, tell)
    print(f"\n{time.monotonic() - begun:.0f} s.")
    if bad:
        sys.exit(1)


PARTS = {"commands": ("Killed, on a full disk, damaged", lambda options: table(options, options.kinds))}
OPTIONS = {
    "count": {"type": int, "default": 20, "help": "kills of each command; half as many full disks and damages"},
    "commands": {"nargs": "+", "default": list(COMMANDS), "choices": list(COMMANDS), "help": "commands"},
    "kinds": {"nargs": "+", "default": list(KINDS), "choices": list(KINDS), "help": "of faults"},
    "seed": {"type": int, "default": 0, "help": "of moments and damages"},
}
