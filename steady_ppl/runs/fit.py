"""A fitted program, the same for every recipe: what was learned, how, and how to keep it."""

from __future__ import annotations

import copy
import hashlib
import inspect
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from steady_ppl import effects
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import RunError
from steady_ppl.likelihood.information import ParameterInformation
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import is_count
from steady_ppl.runs.export import Dynamics
from steady_ppl.runs.folder import (
    FINISHED,
    INFORMATION,
    PARAMETERS,
    POSTERIOR,
    RUN_RECORD,
    read_record,
    run_folder,
    write_record,
)
from steady_ppl.training.loop import Trained
from steady_ppl.utils.context import Displayed
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.files import whole_file
from steady_ppl.utils.tensor_files import damaged, read_tensors, write_tensors
from steady_ppl.utils.text import reason_of

if TYPE_CHECKING:
    import arviz


@dataclass(repr=False)
class Fit(Displayed):
    """A program with fitted parameters.

    Attributes:
        recipe, settings, seed: by name, what it was called with, and its random seed.
        known_start: whether the true first state was given.
        trained: the history; None for a recipe that does not train.
        notes: anything that was rescued, replaced or left out on the way.
        information: how well the trajectories determine the parameters; None where the recipe does not say.
    """

    program: Program
    recipe: str
    settings: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    known_start: bool = False
    trained: Trained | None = None
    notes: list[str] = field(default_factory=list)
    information: ParameterInformation | None = None

    def __repr__(self) -> str:
        return f"Fit({self.program}, recipe={self.recipe!r})"

    def posterior(
        self, data: Trajectories, *, draws: int = 100, particles: int | None = None, every: int = 1, seed: int = 0
    ) -> arviz.InferenceData:
        """Posterior draws of states and channel noise as ArviZ `InferenceData`; see `steady_ppl.runs.posterior`."""
        from steady_ppl.runs.posterior import posterior  # here, for it loads xarray

        settings: dict[str, Any] = {"draws": draws, "particles": particles, "every": every, "seed": seed}
        return posterior(self.program, data, known_start=self.known_start, **settings)

    def forecast(
        self,
        data: Trajectories,
        controls: torch.Tensor | None = None,
        *,
        after: float | None = None,
        step: float | None = None,
        draws: int = 200,
        particles: int | None = None,
        seed: int = 0,
    ) -> arviz.InferenceData:
        """What planned `controls` lead to, or what comes `after` so many seconds; see `steady_ppl.runs.posterior`."""
        from steady_ppl.runs.posterior import forecast

        settings: dict[str, Any] = {"after": after, "step": step, "draws": draws, "particles": particles, "seed": seed}
        return forecast(self.program, data, controls=controls, known_start=self.known_start, **settings)

    def dynamics(self, step: float | None = None) -> Dynamics:
        """A copy of the learned dynamics as a plain torch module; `step` is the program's when not given."""
        return Dynamics(copy.deepcopy(self.program), self.program.step if step is None else step)

    def save(self, folder: str | Path, *, train: Trajectories | None = None, force: bool = False) -> None:
        """Write parameters, record and, with the training trajectories, posterior draws to a run folder; RunError where
        it exists (and is not `force`d) or cannot be written."""
        with run_folder(folder, force=force) as opened:
            self.save_into(opened, train)

    @one_thread()
    def save_into(
        self, folder: Path, train: Trajectories | None = None, begun: Mapping[str, Any] | None = None
    ) -> None:
        """Write into an open run folder; `begun` is what its record already says."""
        (folder / INFORMATION).unlink(missing_ok=True)  # that a resumed training may have left
        write_tensors(folder / PARAMETERS, self.program.state_dict())
        if self.information is not None:
            write_tensors(folder / INFORMATION, *self.information.as_tensors())
        if train is not None:
            from steady_ppl.runs.posterior import drawn_states, netcdf

            drawn = drawn_states(self.program, train, draws=50, known_start=self.known_start, seed=self.seed)
            with whole_file(folder / POSTERIOR, RunError) as beside:
                beside.write_bytes(netcdf(drawn))
        write_record(folder, {**(begun or {}), **self.record(folder)})

    def record(self, folder: Path) -> dict[str, Any]:
        """What `run.json` holds."""
        trained = self.trained
        return {
            "program": program_source(self.program, folder),
            "effects": effects.record(self.program),
            "substeps": self.program.substeps,
            "recipe": self.recipe,
            "status": "interrupted" if trained is not None and trained.interrupted else "finished",
            "known_start": self.known_start,
            "seed": self.seed,
            "settings": self.settings,
            "kept_step": trained.kept if trained else None,
            "history": trained.history if trained else [],
            "notes": self.notes,
            "versions": versions(),
        }

    @classmethod
    def load(cls, folder: str | Path, program: str | Path | Program | None = None) -> Fit:
        """Read a run folder, with the program, or where its file is now; the recorded place when not given.

        Raises:
            RunError: the folder is no finished run, its program moved, changed, came with a run, or has other
                parameters.
            UsageError: an effect that was added to the program is not registered here.
        """
        folder = Path(folder)
        record = read_record(folder)
        if record["status"] not in FINISHED:
            command = "discover" if record["recipe"] == "discover" else "fit"
            raise RunError(f"{folder}: its {command} has not finished: go on with it by `steady {command} … --resume`")
        if not isinstance(program, Program):
            program = _load_recorded(folder, record["program"], program)
        substeps = record["substeps"]
        if not is_count(substeps):
            raise RunError(f"{folder / RUN_RECORD} is damaged: {substeps} substeps a row")
        program.substeps = substeps
        effects.restore(program, record["effects"])
        tensors, _ = read_tensors(folder / PARAMETERS)
        expected = {(name, value.shape) for name, value in program.state_dict().items()}
        found = {(name, value.shape) for name, value in tensors.items()}
        if differing := sorted({name for name, _ in expected ^ found}):
            name = type(program).__name__
            raise RunError(f"{folder}: the parameters do not fit model {name}: {', '.join(differing)}")
        learned = {name for name, _ in program.named_parameters()}
        broken = sorted(name for name, value in tensors.items() if name in learned and not value.isfinite().all())
        if broken:
            raise RunError(f"{folder}: the parameters {', '.join(broken)} are not finite: fit again")
        kinds = {value.dtype for value in tensors.values() if value.is_floating_point()}
        if len(kinds) == 1:
            program.to(kinds.pop())
        program.load_state_dict(tensors)
        trained = None
        if record["kept_step"] is not None:
            trained = Trained(record["history"], record["kept_step"], record["status"] == "interrupted")
        kept = {name: record[name] for name in ("recipe", "settings", "seed", "known_start", "notes")}
        information = None
        if (folder / INFORMATION).exists():
            try:
                information = ParameterInformation.from_tensors(*read_tensors(folder / INFORMATION))
            except (KeyError, ValueError, TypeError) as error:
                raise damaged(folder / INFORMATION, reason_of(error)) from error
        return cls(program, trained=trained, information=information, **kept)


def program_source(program: Program, folder: Path) -> dict[str, str] | None:
    """Class, file relative to the run, and the file's sha256; None where there is no file to load it from."""
    program_class = effects.written_class(program)
    try:
        file = inspect.getsourcefile(program_class)
    except (TypeError, OSError):
        file = None
    if file is None or not Path(file).is_file() or "." in program_class.__qualname__:
        return None
    place = os.path.relpath(file, folder.resolve())
    return {"class": program_class.__qualname__, "file": place, "sha256": sha256(Path(file))}


def sha256(file: Path) -> str:
    """The hash of a file, in hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _load_recorded(folder: Path, source: dict[str, str] | None, moved: str | Path | None) -> Program:
    """The program that the caller names, or the one that the record does: a file that is as it was at the fit, and
    outside of every run folder, for a run of somebody else must not bring code along."""
    if moved is not None:
        return load_program(moved)
    if source is None:
        raise RunError(f"{folder}: its model came from no file: name it with --program PATH (or pass `program=`)")
    try:
        name, recorded, class_name = source["file"], source["sha256"], source["class"]
        file = (folder / name).resolve()
        if not class_name.isidentifier():
            raise ValueError(class_name)
    except (ValueError, OSError) as error:
        raise RunError(f"{folder / RUN_RECORD} is damaged: it does not say which model it is of") from error
    if not file.is_file():
        raise RunError(f"{folder}: its model {name} is gone: name it with --program PATH")
    if any((place / RUN_RECORD).exists() for place in file.parents):
        why = "came with a run, and nothing that comes with one is executed"
        raise RunError(f"{folder}: its model {name} {why}: read it, and name it with --program PATH")
    if sha256(file) != recorded:
        how = "fit again, or accept it with --program PATH"
        raise RunError(f"{folder}: its model {name} changed since the fit: {how}")
    return load_program(f"{file}:{class_name}")


def versions() -> dict[str, str]:
    """Versions that a result may depend on."""
    return {"python": platform.python_version(), "torch_threads": str(torch.get_num_threads())} | packages()


def packages() -> dict[str, str]:
    """Versions of the packages that a result may depend on."""
    found = {}
    for package in ("steady-ppl", "torch", "pyro-ppl", "numpy", "numba"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def packages_text() -> str:
    """Packages and their versions."""
    return ", ".join(f"{name} {number}" for name, number in packages().items())
