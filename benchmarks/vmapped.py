"""A rival's filter on several trajectories at once, by `jax.vmap`; run by `throughput.py` in the rivals' environment.

    python vmapped.py SCRIPT TRAJECTORIES PARTICLES [OPTIONS OF THE SCRIPT]

SCRIPT defines `filt(key)`, which returns log p(y) and paths; prints a line in the format of the scripts.
"""

import contextlib
import io
import os
import runpy
import statistics
import sys
import time

script, trajectories, particles, *options = sys.argv[1:]
sys.path.insert(0, os.path.dirname(script))
sys.argv = [script, "--n", particles, "--reps", "1", *options]
with contextlib.redirect_stdout(io.StringIO()):
    defined = runpy.run_path(script)
jax, rows = defined["jax"], defined["T"]
many = jax.jit(jax.vmap(defined["filt"]))
seconds, evidence = [], []
for run in range(4):
    keys = jax.random.split(jax.random.key(run), int(trajectories))
    began = time.perf_counter()
    log_likelihood, paths = many(keys)
    jax.block_until_ready((log_likelihood, paths))
    seconds.append(time.perf_counter() - began)
    evidence.append(float(log_likelihood.mean()))
median = statistics.median(seconds[1:])
steps = int(trajectories) * int(particles) * rows
print(
    f"vmapped,{particles},{median:.5f},{min(seconds):.5f},{steps / median / 1e6:.3f},{statistics.fmean(evidence):.2f}"
)
