"""Damaged files of every kind that pigjax reads: it reads them or answers with its own error.

    python -m benchmarks fuzz --count 20000
    python -m benchmarks fuzz --seed 0 --only table.npz:17 --keep one    # one input again, and its files

A child process reads, with bounds on memory and time. A reader fails by an exception that is no InputError, by asking
for more memory than the bound, by taking too long, or by ending the process. Same seed, same inputs.
"""

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
import zlib
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.common.command import start_worker
from benchmarks.common.pages import head, row
from benchmarks.fuzz.damage import damaged
from benchmarks.fuzz.readers import READERS
from pigjax.core.errors import InputError

SECONDS = 10.0  # for one input
START_SECONDS = 300.0  # to import, to write the valid files and to read them once
MEMORY = 1 << 30  # beyond that of the process when all valid files were read [bytes]


def fuzz(count, seed=0, readers=None, tell=print):
    """Read `count` damaged inputs; counts of each reader, and failures as {"reader:number": reason}.

    Args:
        count: number of inputs, shared among the readers.
        seed: of the damage.
        readers: names of the readers; None: all.
        tell: gets a line for each failure.
    """
    jobs, counts, failures = _jobs(count, readers), {}, {}
    with tempfile.TemporaryDirectory() as folder:
        at = 0
        while at < len(jobs):
            at = _child(jobs, at, seed, Path(folder), counts, failures, tell)
    return counts, failures


def _jobs(count, names):
    chosen = {name: reader for name, reader in READERS.items() if names is None or name in names}
    total = sum(reader.share for reader in chosen.values())
    jobs = []
    for name, reader in chosen.items():
        jobs += [(name, k) for k in range(-(-count * reader.share // total))]
    return jobs


def _child(jobs, at, seed, folder, counts, failures, tell):
    """Let a child read from job `at` on; the number of the job to go on with."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    listing = folder / "jobs.json"
    listing.write_text(json.dumps(jobs[at:]))
    child = start_worker("fuzz", listing, seed, stderr=subprocess.PIPE)
    lines, said = queue.Queue(), []
    threading.Thread(target=lambda: [*map(lines.put, child.stdout), lines.put(None)], daemon=True).start()
    errors = threading.Thread(target=lambda: said.extend(child.stderr), daemon=True)
    errors.start()
    limit = START_SECONDS

    def note(outcome, why=""):
        name, number = jobs[at]
        counts.setdefault(name, Counter())[outcome] += 1
        if outcome == "failed":
            failures[f"{name}:{number}"] = why
            tell(f"{name}:{number} (--seed {seed}): {why}")

    try:
        while at < len(jobs):
            line = lines.get(timeout=limit)
            if line is None:
                child.wait()
                errors.join(5)
                if limit == START_SECONDS:
                    raise RuntimeError("the child ended before the first input: " + "".join(said)[-2000:])
                note("failed", f"the process ended ({child.returncode}): {''.join(said).strip()[-300:]}")
                return at + 1
            limit = SECONDS
            outcome = json.loads(line)
            if "invalid" in outcome:
                name = outcome["invalid"]
                failures[f"{name}:valid"] = outcome["why"]
                tell(f"{name}: the valid files were not read: {outcome['why']}")
            elif "outcome" in outcome:
                note(outcome["outcome"], outcome["why"])
                at += 1
    except queue.Empty:
        note("failed", f"no answer within {limit:g} s")
        return at + 1
    finally:
        child.kill()
        child.wait()
    return at


def worker(listing, seed):
    """The child: reads each job, and prints a line before the first and after each."""
    listing, seed = Path(listing), int(seed)
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(**outcome):
        print(json.dumps(outcome), file=out, flush=True)

    warnings.simplefilter("ignore")
    jobs = json.loads(listing.read_text())
    sources = {}
    for name in dict.fromkeys(name for name, _ in jobs):
        sources[name] = folder = listing.parent / "valid" / name.replace(".", "-")
        folder.mkdir(parents=True)
        try:
            READERS[name].write(folder)
            READERS[name].read(folder)
        except Exception as error:
            tell(invalid=name, why=f"{type(error).__name__}: {error}")
    _bound_memory()
    tell(ready=True)
    others = [path.read_bytes() for path in sorted(listing.parent.glob("valid/**/*")) if path.is_file()]
    for name, number in jobs:
        outcome, why = _read_one(READERS[name], sources[name], _generator(seed, name, number), others)
        tell(outcome=outcome, why=why)


def _generator(seed, name, number):
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number])


def _bound_memory():
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)
    except (ImportError, OSError):  # where there is no such bound
        pass


def _read_one(reader, folder, rng, others):
    """Damage a file of the folder, read, and put the file back."""
    file, change = _damage_of(reader, folder, rng, others)
    before = file.read_bytes()
    try:
        _put(file, change)
        reader.read(folder)
        return "read", ""
    except InputError as error:
        if _names_memory(error):
            return "failed", f"asked for more memory than there is: {error}"
        return "refused", str(error)
    except Exception as error:
        return "failed", f"{type(error).__name__}: {str(error)[:300]}"
    finally:
        if file.is_dir():
            shutil.rmtree(file)
        file.write_bytes(before)


def _damage_of(reader, folder, rng, others):
    files = sorted(path for path in folder.glob(reader.files) if path.is_file())
    file = files[rng.integers(len(files))]
    return file, damaged(file.name, file.read_bytes(), rng, others)


def _put(file, content):
    if content is None:
        file.unlink()
        file.mkdir()
    else:
        file.write_bytes(content)


def _names_memory(error):
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__
    return False


def _again(which, seed, keep):
    """One input once more in this process, with its traceback; its files stay in the folder `keep`."""
    name, _, number = which.rpartition(":")
    keep.mkdir(parents=True)
    READERS[name].write(keep)
    if number != "valid":
        others = [path.read_bytes() for path in sorted(keep.glob("**/*")) if path.is_file()]
        file, change = _damage_of(READERS[name], keep, _generator(seed, name, int(number)), others)
        print(f"damaged: {file}")
        _put(file, change)
    print(READERS[name].read(keep))


def study(options):
    """Print the counts of each reader; ends the process with 1 where one failed."""
    if options.only:
        _again(options.only, options.seed, options.keep or Path(tempfile.mkdtemp()) / "input")
        return
    counts, failures = fuzz(options.count, options.seed, options.readers)
    print(head("reader", "read", "refused", "failed"))
    for name, found in {**counts, "all": sum(counts.values(), Counter())}.items():
        print(row(name, found["read"], found["refused"], found["failed"]))
    if failures:
        sys.exit(1)


PARTS = {"readers": ("Damaged files", study)}
OPTIONS = {
    "count": {"type": int, "default": 2000, "help": "inputs, shared among the readers"},
    "seed": {"type": int, "default": 0, "help": "of the damage"},
    "readers": {"nargs": "*", "choices": READERS, "help": "names of readers; all if not given"},
    "only": {"help": "READER:NUMBER, as a failure was printed"},
    "keep": {"type": Path, "help": "with --only: a new folder for the damaged files"},
}
