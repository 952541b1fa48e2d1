"""One page of HTML that says what a program explains of some drives, where it fails and what it lacks."""

from steady_ppl.reporting.gathering import Report, report

__all__ = ["Report", "report"]
