"""The command line of all benchmarks, and the processes that some of them start.

A benchmark is a module of this package, or `parts` of a folder. It defines

- `PARTS`: title and function by name. A function takes the options, prints its tables as they come or gives their text.
- `OPTIONS`: more options of its command line, settings of `add_argument` by name; may be left out.
- `DEVICES`: host devices on a CPU, None for one a core; the default is 1.
- `worker(*arguments)`: the task of a process started by `start_worker`; only where there is such a process.

The first line of its docstring describes it in the list.
"""

import argparse
import ast
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks.common.pages import MEDIA, PAGES, ROOT, kept, write_section

HERE = Path(__file__).parents[1]


def names() -> dict[str, str]:
    """Description of each benchmark by its name; nothing is imported."""
    files = {path.stem: path for path in HERE.glob("[a-z]*.py")}
    files |= {path.parent.name: path for path in HERE.glob("*/parts.py")}
    said = {name: ast.get_docstring(ast.parse(files[name].read_text())) or "" for name in sorted(files)}
    return {name: text.partition("\n")[0] for name, text in said.items()}


def load(name: str) -> ModuleType:
    """The module that defines a benchmark."""
    folder = (HERE / name).is_dir()
    return importlib.import_module(f"benchmarks.{name}" + ".parts" * folder)


def main(arguments: list[str]) -> None:
    """Run the parts of one benchmark; without a name, list all."""
    known = names()
    if not arguments or arguments[0] in ("-h", "--help"):
        print("python -m benchmarks NAME [part ...] [--write [PAGE]]; --help after a name tells its parts\n")
        print("\n".join(f"{name:15s} {said}" for name, said in known.items()))
        return
    name, *rest = arguments
    if name not in known:
        sys.exit(f"python -m benchmarks: no benchmark {name}: choose from {', '.join(known)}")
    import matplotlib  # here, so that the list comes at once

    matplotlib.use("Agg")
    module = load(name)
    if rest[:1] == ["--worker"]:
        module.worker(*rest[1:])
        return
    parser = parser_of(name, module)
    options = parser.parse_args(rest)
    if unknown := set(options.parts) - set(module.PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}: choose from {', '.join(module.PARTS)}")
    if options.write and options.write.suffix != ".md":
        parser.error(f"--write {options.write}: a page ends in .md; name parts before --write")
    options.media = options.media or (MEDIA if options.write else ROOT / "out" / "media")
    options.media.mkdir(parents=True, exist_ok=True)
    run(module, options, f"python -m benchmarks {name}", _changed(parser, module, options), known[name])


def parser_of(name: str, module: ModuleType) -> argparse.ArgumentParser:
    """Options that all benchmarks have, and those of one."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}", description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(module.PARTS)}; all without")
    page = PAGES / f"{name.upper()}.md"
    parser.add_argument("--write", nargs="?", type=Path, const=page, metavar="PAGE", help=f"page whose sections are"
                        f" replaced; {page.relative_to(ROOT)} if none is named")  # fmt: skip
    parser.add_argument("--media", type=Path, help="folder of pictures; docs/media with --write, else out/media")
    parser.add_argument("--devices", type=int, default=getattr(module, "DEVICES", 1), help="host devices on a CPU")
    for option, settings in getattr(module, "OPTIONS", {}).items():
        parser.add_argument(f"--{option}", **settings)
    return parser


def run(module: ModuleType, options: argparse.Namespace, command: str, changed: str, heading: str) -> None:
    """Print the chosen parts, each with its command, the machine and its cost, and write those asked for."""
    from benchmarks.common.timing import machine, peak_memory, processor_time, use_host_devices

    use_host_devices(options.devices)
    for name in options.parts or module.PARTS:
        title, study = module.PARTS[name]
        print(f"\n## {title}\n")
        worked = processor_time()
        with kept() as text:
            print(f"`{command} {name}{changed}`, {machine()}\n")
            if said := study(options):
                print(said)
            worked = processor_time() - worked
            print(f"\n{worked:.0f} s of processor time, at most {peak_memory():.1f} GB.")
        if options.write:
            write_section(options.write, heading.rstrip("."), title, text.getvalue())


def start_worker(name: str, *arguments: Any, **settings: Any) -> subprocess.Popen:
    """A process that calls the `worker` of a benchmark with these arguments, as texts.

    Args:
        name: of the benchmark.
        arguments: for its worker.
        settings: of `subprocess.Popen`.
    """
    command = [sys.executable, "-m", "benchmarks", name, "--worker", *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, **settings)


def _changed(parser: argparse.ArgumentParser, module: ModuleType, options: argparse.Namespace) -> str:
    """The options that are not as by default, as they are written."""
    said = []
    for option in ("devices", *getattr(module, "OPTIONS", {})):
        destination = option.replace("-", "_")
        value = getattr(options, destination)
        if value != parser.get_default(destination):
            values = [] if value is True else value if isinstance(value, list) else [value]
            texts = (f"{value:g}" if isinstance(value, float) else str(value) for value in values)
            said.append(" ".join([f" --{option}", *texts]))
    return "".join(said)
