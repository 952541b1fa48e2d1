"""`steady study` and `steady plot-study`: grids of fits or searches, and pictures of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.counted import count
from steady_ppl.errors import UsageError
from steady_ppl.utils.text import tell


def study(
    plan: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="What is compared with what.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the results; one that is there is gone on with.")],
    workers: Annotated[int | None, count("Processes of this machine; its cores when not given.")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:PORT, in place of processes.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of the logs or tables, if elsewhere.")] = None,
    again: Annotated[bool, typer.Option("--again", help="Try jobs that have failed once more.")] = False,
) -> None:
    """Compute a grid of programs, data, recipes, settings and seeds, each job by itself.

    Results come into DIR/results.parquet, a row a job. The same command goes on where it was stopped, and computes only
    what is not there or has changed. `steady plot-study DIR` draws it.
    """
    import joblib

    from steady_ppl.studies.executors import Cluster, Local
    from steady_ppl.studies.plan_file import read_plan
    from steady_ppl.studies.runner import require_runnable, run_study
    from steady_ppl.utils.text import say

    if workers is not None and cluster is not None:
        raise UsageError("--workers are processes of this machine: take it or --cluster")
    read = read_plan(plan, data)
    require_runnable(read)
    place = Cluster(cluster) if cluster is not None else Local(workers or joblib.cpu_count(only_physical_cores=True))
    failed = run_study(read, out, place, again=again, say=say)
    tell(f"{out / 'results.parquet'}: {len(read.jobs) - failed} of {len(read.jobs)} jobs done")
    if failed:
        jobs = "job" if failed == 1 else "jobs"
        say(f"{failed} {jobs} failed: column reason says why, --again tries them once more", always=True)
        raise typer.Exit(1)


def plot_study(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `steady study`.")],
    out: Annotated[Path | None, typer.Option("--out", help="Picture to write; DIR/study.png when not given.")] = None,
) -> None:
    """Draw what a study has found so far, as its [picture] says, beside what is published."""
    from steady_ppl.studies.pictures import study_picture
    from steady_ppl.studies.plan import recorded_plan
    from steady_ppl.studies.table import read_results
    from steady_ppl.utils.files import require_picture, write_picture

    plan, place = recorded_plan(folder), out or folder / "study.png"
    require_picture(place)
    write_picture(study_picture(plan, read_results(folder)), place)
    tell(place)
