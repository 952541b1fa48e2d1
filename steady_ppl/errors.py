"""What can go wrong for a user, as exceptions that carry what a caller needs.

Programming errors stay ordinary Python errors.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class SteadyError(Exception):
    """A problem the user can mend. The message says what was got, what was expected and what to do.

    Attributes:
        exit_code: the command line's exit status, 2 for bad input, 1 for a failed computation.
    """

    exit_code = 2


class DataError(SteadyError):
    """A table or log that cannot be used.

    Attributes:
        column: the offending column, or None.
        trajectory: the offending trajectory's label, or None.
        row: the 1-based data row of the table (the header not counted), or None.
    """

    def __init__(
        self, message: str, *, column: str | None = None, trajectory: str | None = None, row: int | None = None
    ) -> None:
        super().__init__(message)
        self.column, self.trajectory, self.row = column, trajectory, row


class ProgramError(SteadyError):
    """A program file that does not load, lacks a method, or whose shapes do not fit.

    Attributes:
        site: the Pyro site or method at fault, or None.
    """

    def __init__(self, message: str, *, site: str | None = None) -> None:
        super().__init__(message)
        self.site = site


class RunError(SteadyError):
    """A run folder that cannot be written, read or resumed."""


class UsageError(SteadyError):
    """An option or a name that does not exist or does not apply."""


class ComputationError(SteadyError):
    """A computation whose result cannot be used."""

    exit_code = 1


class FilterError(ComputationError):
    """The particle filter broke down: every weight is zero, or a particle is not finite.

    Attributes:
        trajectory: the trajectory's label.
        time: seconds since its first row.
    """

    def __init__(self, message: str, *, trajectory: str | None = None, time: float | None = None) -> None:
        super().__init__(message)
        self.trajectory, self.time = trajectory, time


class TrainingError(ComputationError):
    """Training failed, for example on a loss that is not finite."""


class TableWarning(UserWarning):
    """A table was read that is not written as it should be."""


def require(holds: bool, setting: str, value: object, wanted: str) -> None:
    """Refuse a setting's value unless it is what is wanted, such as "at least 1".

    Raises:
        UsageError: it is not.
    """
    if not holds:
        raise UsageError(f"{setting} is {value}: it must be {wanted}")


@contextmanager
def labelled(what: str) -> Iterator[None]:
    """Say before the message of a SteadyError of the block what it is about."""
    try:
        yield
    except SteadyError as error:
        error.args = (f"{what}: {error}",)
        raise
