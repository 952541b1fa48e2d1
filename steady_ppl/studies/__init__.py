"""Grids of independent jobs, on local processes or a Dask cluster, whose results are one Parquet table.

`plan` reads what is compared with what from TOML, `job` computes one cell of that grid, `executors` say where, `runner`
sends jobs there, `table` keeps what has come in, `pictures` draws. Nothing here fits or judges; jobs call what does.
"""
