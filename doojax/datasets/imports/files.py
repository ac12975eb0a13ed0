"""Trajectories in one file, .npz or .csv, as arrays."""

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np

from doojax.datasets.imports.trajectories import NEEDED, OPTIONAL
from doojax.reading import read_text

AXES = "xyz"


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file, those that an import knows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no .npz, or has arrays of other names.
    """
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # of damaged archives numpy raises anything
        raise ValueError(f"{file} is neither a .csv nor a .npz of arrays: {error}") from error
    unknown = sorted(set(arrays) - {*NEEDED, *OPTIONAL})
    if unknown:
        raise ValueError(f"{file} holds {', '.join(unknown)}: expected {', '.join((*NEEDED, *OPTIONAL))}")
    return arrays


def read_csv(file: Path) -> dict[str, np.ndarray]:
    """Points and grippers of a .csv file: see `import_trajectories`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a column is missing, a value is no number, or trajectories differ in length.
    """
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    lines = list(csv.reader(read_text(file).splitlines()))
    header = [name.strip() for name in lines[0]] if lines else []
    columns = {name: header.index(name) for name in header}
    counts = {
        kind: sum(name.startswith(kind) and name.endswith("_x") for name in header)
        for kind in ("point", "gripper")
    }
    wanted = [f"{kind}{i}_{axis}" for kind, count in counts.items() for i in range(count) for axis in AXES]
    missing = [name for name in ("trajectory", "step", *wanted) if name not in columns]
    if missing or not all(counts.values()):
        raise ValueError(
            f"{file} lacks the columns {', '.join(missing) or 'of points or grippers'}: expected trajectory, "
            "step, point0_x, point0_y, point0_z, ..., gripper0_x, ..."
        )
    found: dict[str, list[tuple[int, list[float]]]] = defaultdict(list)
    for number, line in enumerate(lines[1:], start=2):
        try:
            step, values = int(line[columns["step"]]), [float(line[columns[name]]) for name in wanted]
        except (ValueError, IndexError) as error:
            raise ValueError(f"{file}, line {number}: {error}") from error
        found[line[columns["trajectory"]]].append((step, values))
    rows = [np.array([values for _, values in sorted(states)]) for states in found.values()]
    lengths = sorted({len(row) for row in rows})
    if len(lengths) != 1:
        raise ValueError(f"{file} has trajectories of {lengths} states: expected one length, of at least 2")
    every = np.stack(rows).reshape(len(rows), lengths[0], -1, 3)
    return {"points": every[:, :, : counts["point"]], "grippers": every[:, :, counts["point"] :]}
