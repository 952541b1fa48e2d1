"""Find a recipe, hand it a program and tables, and keep what it learned in a run folder."""

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError, require
from steady_ppl.gaussian.linearize import require_linear
from steady_ppl.likelihood.parameters import MAX_LEARNABLE_NUMBERS
from steady_ppl.model.loading import program_file, run_file
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, for_program
from steady_ppl.runs.diagnostics import diagnose_fit, diagnose_units
from steady_ppl.runs.fit import Fit, program_source, sha256, versions
from steady_ppl.runs.folder import CHECKPOINT, read_record, require_same, run_folder, write_record
from steady_ppl.runs.workbench import workbench
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.tensor_files import read_tensors

Recipe = Callable[..., Fit]
SETTING_TYPES = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a word", "None": "none"}


def recipe_file(name: str) -> Path:
    """Where a recipe is: `fit-truth` is `inference/fit_truth.py`, others are paths. UsageError: there is none."""
    if name.endswith(".py"):
        if not Path(name).is_file():
            raise UsageError(f"no recipe file {name}")
        return Path(name)
    folder = workbench() / "inference"
    known = sorted(path.stem.replace("_", "-") for path in folder.glob("[!_]*.py"))
    if name not in known:
        raise UsageError(f"no recipe {name!r}; there are {', '.join(known)}, or a PATH.py of your own")
    return folder / f"{name.replace('-', '_')}.py"


def find_recipe(name: str) -> Recipe:
    """The `fit` function of a recipe, by name or path; UsageError where there is no such recipe or function."""
    file = recipe_file(name)
    found = getattr(run_file(file), "fit", None)
    if not callable(found):
        raise UsageError(f"recipe {file.name} has no function fit(program, table, valid, ...)")
    return found


def require_settings(name: str, recipe: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Refuse what is no setting of a recipe, or of `discover`, or of another kind than its annotation says; the
    UsageError names it, and the settings that there are."""
    settings = {
        setting: parameter
        for setting, parameter in list(inspect.signature(recipe).parameters.items())[3:]
        if parameter.kind is not parameter.VAR_KEYWORD and setting not in ("known_start", "seed")
    }
    for option, value in options.items():
        if option not in settings:
            raise UsageError(f"{name} has no setting {option}; it has {', '.join(settings) or 'none'}")
        annotation = inspect.formatannotation(settings[option].annotation)
        kinds = annotation.strip("'").split(" | ")  # by name: a recipe's annotations may not be there to be evaluated
        given = "None" if value is None else type(value).__name__
        if all(kind in SETTING_TYPES for kind in kinds):
            fits = given in kinds or (given == "int" and "float" in kinds)
            require(fits, option, repr(value), " or ".join(SETTING_TYPES[kind] for kind in kinds))


def trains(recipe: Recipe) -> bool:
    """Whether a recipe takes checkpoint, resume and progress of `train`."""
    return any(parameter.kind is parameter.VAR_KEYWORD for parameter in inspect.signature(recipe).parameters.values())


def suited_recipe(
    program: Program, table: Trajectories, options: Mapping[str, Any], *, known_start: bool = False, device: str = "cpu"
) -> tuple[str, str]:
    """The recipe for a program where none is named, and why, in words.

    `likelihood` takes some dozens of learnable numbers and noise that can be linearised; `steady` takes any program,
    and settings (`options`) that `likelihood` has not ask for it.
    """
    own = inspect.signature(find_recipe("likelihood")).parameters
    if foreign := [name for name in options if name not in own]:
        return "steady", f"{foreign[0]} is a setting of it"
    if device != "cpu":
        return "steady", f"it computes on {device}"
    count = sum(value.numel() for value in program.parameters() if value.requires_grad)
    if not 0 < count <= MAX_LEARNABLE_NUMBERS:
        return "steady", f"{count} learnable numbers, where likelihood takes 1 to {MAX_LEARNABLE_NUMBERS}"
    problem = Problem.of_table(program, table, known_start)
    try:
        require_linear(problem, "likelihood needs a model that can be linearised")
    except UsageError as error:
        return "steady", str(error)
    return "likelihood", f"{count} learnable numbers and noise that can be linearised; --recipe steady takes any"


@one_thread()
def run_recipe(
    name: str | None,
    program: Program,
    table: Trajectories,
    valid: Trajectories | None,
    folder: Path,
    *,
    options: Mapping[str, Any],
    known_start: bool = False,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    force: bool = False,
    progress: bool = False,
) -> Fit:
    """Fit and save. Every input is checked before the run folder is made.

    Args:
        name: the recipe; the one that suits the program when None, see `suited_recipe`, or that of the run on `resume`.
        options: its own keyword arguments; one that it does not take is an error.
        device: "cpu" or "cuda".
        resume: go on from the run's checkpoint; program, table, options and seed must be those of the run.

    Raises:
        UsageError: unknown recipe or option, or no such device.
        RunError: the folder exists, or does not match on `resume`.
    """
    reason = ""
    if name is None:
        name, reason = suited_recipe(program, table, options, known_start=known_start, device=device)
        if resume and (begun_with := read_record(folder)["recipe"]) != name:
            name, reason = begun_with, ""
    recipe = find_recipe(name)
    require_settings(f"recipe {name}", recipe, options)
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: this machine has no CUDA device")
    program.to(device)
    doubts: list[str] = []
    for part in (table, valid):
        if part is not None:
            columns = for_program(program, part)
            doubts += [doubt for doubt in diagnose_units(program, columns) if doubt not in doubts]
            if known_start:
                columns.require_known_start()
    declared = {key: value.clone() for key, value in program.state_dict().items()}
    said: dict[str, Any] = {"recipe": name, "status": "training", "known_start": known_start, "seed": seed}
    said["options"] = json.loads(json.dumps(dict(options)))  # as the record will say them
    named = {option: program_file(value) for option, value in options.items() if ".py" in str(value)}
    said["option_files"] = {option: sha256(file) for option, file in named.items() if file.is_file()}
    begun = begun_record(program, folder, table, valid, **said)
    arguments = {"known_start": known_start, "seed": seed, **options}
    if trains(recipe):
        arguments |= {"checkpoint": folder / CHECKPOINT, "resume": resume, "progress": progress}
    try:
        call = inspect.signature(recipe).bind(program, table, valid, **arguments)
    except TypeError as error:
        raise UsageError(f"recipe {name}: its fit does not take what a recipe is called with: {error}") from error
    if resume:
        require_same(folder, begun)
        read_tensors(folder / CHECKPOINT)
    with run_folder(folder, force=force, resume=resume):
        if not resume:
            write_record(folder, begun)
        fitted = recipe(*call.args, **call.kwargs)
        if not isinstance(fitted, Fit):
            raise UsageError(f"recipe {name} returned {type(fitted).__name__}, not a Fit")
        fitted.notes += doubts + diagnose_fit(fitted, declared)
        if reason:
            fitted.notes.insert(0, f"recipe {name}: {reason}")
        if valid is None and trains(recipe) and not (fitted.trained and fitted.trained.interrupted):
            fitted.notes.append("no --valid table: trained to the last step, nothing held out decides when to stop")
        fitted.save_into(folder, table, begun)
    return fitted


def begun_record(
    program: Program, folder: Path, table: Trajectories, valid: Trajectories | None, **said: Any
) -> dict[str, Any]:
    """What the record of a run says before there is a result: its program and tables, and what else is `said`."""
    return {
        "program": program_source(program, folder),
        "begun_substeps": program.substeps,
        "table_sha256": fingerprint(table),
        "valid_sha256": fingerprint(valid) if valid is not None else None,
        "versions": versions(),
        **said,
    }


def fingerprint(table: Trajectories) -> str:
    """A hash of everything that a fit can depend on."""
    digest = hashlib.sha256(repr((table.labels, table.control_names, table.measurement_names)).encode())
    for values in (table.time, table.controls, table.measurements, table.observed, table.lengths, table.states):
        digest.update(b"-" if values is None else values.numpy(force=True).tobytes())
    return digest.hexdigest()
