"""The form of the JSON in a run folder, by which a damaged or a foreign file is told."""

from __future__ import annotations

from steady_ppl.utils.schema import ANYTHING, LINES, NUMBER, TEXT, TRUTH, WHOLE, Absent, Among, Maybe

FINISHED = ("finished", "interrupted")  # what the record of a run that can be used says

FORMAT = 1
"""Number of the form of a run folder, in `run.json`; a change that this reader could not read raises it."""

BEGUN_RECORD = {
    "format": Absent(WHOLE),
    "program": Maybe({"class": TEXT, "file": TEXT, "sha256": TEXT}),
    "recipe": TEXT,
    "status": TEXT,
    "command": Absent(Maybe(TEXT)),
}
"""The form of `run.json` from the first moment."""

FINISHED_RECORD = {
    "effects": Absent(LINES),
    "substeps": Absent(WHOLE),
    "known_start": TRUTH,
    "seed": WHOLE,
    "settings": {str: ANYTHING},
    "kept_step": Maybe(WHOLE),
    "history": [{str: ANYTHING}],
    "notes": LINES,
}
"""What it has besides when the run has ended."""

NUMBERS = Maybe(Among((NUMBER, [Maybe(NUMBER)])))
FOUND = {
    "source": Absent(TEXT),
    "sentence": TEXT,
    "complete": Absent(TRUTH),
    "candidates": [
        {
            "effect": TEXT,
            "kind": TEXT,
            "p_value": Maybe(NUMBER),
            "coefficient": NUMBERS,
            "sd": NUMBERS,
            "absent": Maybe(NUMBER),
            "unit": TEXT,
            "detection_limit": NUMBERS,
            "heldout_gain": Maybe(NUMBER),
            "heldout_gain_ci": Maybe([NUMBER]),
            "note": Maybe(TEXT),
        }
    ],
    "effects": [
        {
            "effect": TEXT,
            "text": TEXT,
            "unit": TEXT,
            "class": LINES,
            "confidence": Maybe(NUMBER),
            "coefficient": [NUMBER],
            "interval_90": [[NUMBER]],
            "heldout_gain": Maybe(NUMBER),
        }
    ],
    "shape": Maybe({"channel": TEXT, "variable": TEXT, "points": [NUMBER], "curve": [NUMBER], "band": [NUMBER]}),
    "doubts": LINES,
    "notes": LINES,
    "next_run": Maybe({"between": LINES, "way": TEXT, "separation": NUMBER, "usual": NUMBER}),
}
"""The form of what `discover` writes, as far as it is shown."""
