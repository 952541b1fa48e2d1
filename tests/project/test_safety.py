"""What the sources must not do, and that a whole loop reads no pickle and runs nobody else's code."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from examples import MODELS
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from small import HOVERCRAFT, simulated, written

ROOT = MODELS.parent
ROOMS = ("steady_ppl", "models", "inference", "benchmarks", "docs")
MODULES = {
    "pickle", "cPickle", "_pickle", "cloudpickle", "dill", "marshal", "shelve", "joblib", "yaml", "ruamel",
    "requests", "httpx", "urllib", "http", "ftplib", "smtplib", "socket",
}  # fmt: skip
CALLS = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen", "os.execv", "tempfile.mktemp", "torch.load",
    "torch.save", "torch.hub.load", "torch.jit.load", "torch.jit.save", "pd.read_pickle", "pandas.read_pickle",
    "importlib.import_module", "import_module", "runpy.run_path", "runpy.run_module",
}  # fmt: skip
METHODS = {"exec_module", "load_module", "to_pickle", "read_pickle"}
ALLOWED = {
    ("steady_ppl/model/loading.py", "exec_module"): "a program or recipe that the person names is code",
    (
        "steady_ppl/studies/executors.py",
        "joblib",
    ): "hands jobs to its own processes, or to a cluster that is named",
    ("steady_ppl/cli/learn.py", "joblib"): "counts the cores",
    ("steady_ppl/utils/cores.py", "joblib"): "counts the cores",
    ("benchmarks/vmapped.py", "runpy.run_path"): "runs the script that the person names",
    ("benchmarks/report_page.py", "urllib"): "asks the browser that it started on this machine",
}


def sources() -> Iterator[tuple[str, str]]:
    for room in ROOMS:
        for file in sorted((ROOT / room).rglob("*.py")):
            yield str(file.relative_to(ROOT)), file.read_text()
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in nbformat.read(file, as_version=4).cells:
            if cell.cell_type == "code":
                yield str(file.relative_to(ROOT)), re.sub("(?m)^[%!].*", "", cell.source)


def refusals(text: str) -> list[tuple[str, int]]:
    """What a source does that none may do, with its line."""
    found: list[tuple[str, int]] = []
    for node in ast.walk(ast.parse(text)):
        imported = []
        if isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            imported = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in imported:
            if name.partition(".")[0] in MODULES:
                found.append((name.partition(".")[0], node.lineno))
            elif name in CALLS:
                found.append((name, node.lineno))
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            if name in CALLS:
                found.append((name, node.lineno))
            elif isinstance(node.func, ast.Attribute) and node.func.attr in METHODS:
                found.append((node.func.attr, node.lineno))
            for keyword in ("shell", "allow_pickle"):
                if given.get(keyword, "False") != "False":
                    found.append((keyword, node.lineno))
    return list(dict.fromkeys(found))


@pytest.mark.slow
def test_no_source_reads_pickles_evaluates_text_or_calls_out() -> None:
    used, seen = set(), 0
    for name, text in sources():
        seen += 1
        for what, line in refusals(text):
            assert (name, what) in ALLOWED, f"{name}, line {line}: {what}"
            used.add((name, what))
    assert seen > 200 and used == ALLOWED.keys(), ALLOWED.keys() - used


@pytest.mark.parametrize(
    "text",
    [
        "import pickle", "from pickle import loads", "import joblib", "import yaml",
        "from urllib.request import urlopen",
        "torch.load(f)", "torch.save(x, f)", "np.load(f, allow_pickle=True)", "np.load(f, allow_pickle=yes)", "eval(s)",
        "exec(s)", "subprocess.run(s, shell=True)", "tempfile.mktemp()", "from tempfile import mktemp", "os.system(s)",
        "pd.read_pickle(f)", "import numpy, dill as d", "def f():\n    import requests", "frame.to_pickle(f)",
    ],
)  # fmt: skip
def test_the_rule_sees(text: str) -> None:
    assert refusals(text)


@pytest.mark.parametrize(
    "text", ["np.load(f, allow_pickle=False)", "subprocess.run([s])", "model.eval()", "re.compile(s)"]
)
def test_the_rule_lets_pass(text: str) -> None:
    assert not refusals(text)


# Every name that a pickle asks for is announced by the interpreter itself, whichever way it is read. numba's cache of
# compiled kernels is pickled; it lies where Python's own compiled files do, and is nobody else's. All else is an error.
LOOP = """
import sys
numba = []
def listen(event, arguments):
    if event in ("pickle.find_class", "marshal.loads", "marshal.load"):
        frame, files = sys._getframe(1), []
        while frame is not None:
            files.append(frame.f_code.co_filename.replace("\\\\", "/"))
            frame = frame.f_back
        if event.startswith("marshal") and any("importlib" in file or "zipimport" in file for file in files[:3]):
            return  # Python's own compiled files
        if any(file.endswith("/numba/core/caching.py") for file in files):
            numba.append(arguments)
        elif not any("/numba/" in file for file in files[:4]):
            raise RuntimeError(f"{event} {arguments}: {files[:6]}")
    elif event == "subprocess.Popen" and arguments[0] == "uname":
        return  # Python's own `platform`
    elif event in ("socket.connect", "subprocess.Popen", "os.system", "os.exec", "urllib.Request"):
        raise RuntimeError(f"{event} {arguments}")
sys.addaudithook(listen)
import pickle, torch
def refuse(*arguments, **named):
    raise RuntimeError("torch.load")
torch.load = torch.save = refuse
from steady_ppl.cli.main import main
for line in open(sys.argv[1]).read().splitlines():
    code = main(line.split(" "))
    assert code == 0, (line, code)
try:
    pickle.loads(pickle.dumps(pickle.PickleError))
except RuntimeError as error:
    print("heard", "pickle.find_class" in str(error), len(numba) > 0)
"""


@pytest.mark.slow
def test_a_whole_loop_reads_no_pickle_and_calls_nobody(tmp_path: Path) -> None:
    """fit, resume, check, states, evaluate, discover, add, prove and report, with the interpreter telling of every
    pickle that is read."""
    table = written(tmp_path / "drives.csv", simulated(trajectories=10, rows=21))
    shutil.copy(HOVERCRAFT, tmp_path)
    run, few = tmp_path / "run", "--guide bootstrap --particles 20 --draws 3"
    found, windy = tmp_path / "found", tmp_path / "windy"
    lines = [
        f"fit {HOVERCRAFT} {table} --known-start {few} --steps 3 --out {run}",
        f"fit {HOVERCRAFT} {table} --known-start {few} --steps 3 --resume --out {run}",
        f"check {run} {table} --simulations 20 --json {tmp_path / 'check.json'}",
        f"states {run} {table} --out {tmp_path / 'states.nc'}",
        f"evaluate {run} {table} --particles 50 --rollouts 5 --json {tmp_path / 'errors.json'}",
        f"discover {run} {table} --simulations 50 --out {found} --json {tmp_path / 'found.json'}",
        f"add {tmp_path / 'hovercraft.py'} wind=1,1 --out {windy}.py",
        f"fit {windy}.py {table} --recipe hand --out {windy}",
        f"prove {run} {windy} {table} --json {tmp_path / 'proof.json'}",
        f"report {run} {windy} {table} --discovery {found} --out {tmp_path / 'page.html'}",
    ]
    (tmp_path / "lines").write_text("\n".join(lines))
    command = [sys.executable, "-W", "ignore", "-c", LOOP, str(tmp_path / "lines")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.splitlines()[-1] == "heard True True"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a/msg/B:\n  import os\nclass C", "float64 x\n"),
        ('a/msg/"""', "float64 x\n"),
        ("a/msg/B", "float64 __import__('os')\n"),
        ("a/msg/B", "float64[__import__] x\n"),
        ("a/msg/B", "__import__('os')/C x\n"),
    ],
)
def test_definitions_of_a_bag_are_compiled_as_names_only(name: str, text: str) -> None:
    """rosbags makes Python of the definitions that a bag brings, of nothing but identifiers and numbers."""
    with pytest.raises(Exception, match="Could not parse"):
        get_typestore(Stores.EMPTY).register(get_types_from_msg(text, name))


@pytest.mark.parametrize("kind", ["int8", "string"])
@pytest.mark.parametrize("text", ["__import__('os').abort()", "abc'+__import__('os').abort()", 'a"""b', "'\\'"])
def test_text_in_a_bags_definition_stays_text(kind: str, text: str) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(f"{kind} X={text}\nfloat64 x\n", "a/msg/B"))
    constants, fields = store.fielddefs["a/msg/B"]
    assert [field for field, _ in fields] == ["x"] and type(constants[0][2]) is str


# --- what is installed ------------------------------------------------------------------------------------------------
def locked(name: str) -> dict[str, list[str]]:
    """Packages of a lock, and the hashes of each, in all its versions."""
    found: dict[str, list[str]] = {}
    for line in (ROOT / "requirements" / name).read_text().splitlines():
        if package := re.match(r"([a-z0-9-]+)==[0-9]", line):
            last = found.setdefault(package[1], [])
        elif said := re.fullmatch(r"    --hash=sha256:([0-9a-f]{64})( \\)?", line):
            last.append(said[1])
        else:
            assert not line or line.lstrip().startswith("#"), line
    return found


def test_every_dependency_is_locked_with_hashes() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)]
    names = {re.split(r"[^A-Za-z0-9-]", one)[0].lower() for one in wanted}
    everything, torch = locked("locked.txt"), locked("torch.txt")
    assert names <= everything.keys() | {"torch"} and torch.keys() == {"torch"} and "torch" not in everything
    assert all(everything.values()) and len(torch["torch"]) > 20
    assert not [name for name in everything if "nvidia" in name or "cuda" in name]
    assert "://" not in (ROOT / "requirements/locked.txt").read_text() + (ROOT / "requirements/torch.txt").read_text()
