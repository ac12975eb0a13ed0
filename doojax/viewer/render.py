"""`doojax render`: pictures and recordings without a browser."""

from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console

from doojax.datasets import Dataset
from doojax.datasets.progress import announce
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.viewer.arms import strip
from doojax.viewer.episodes import holds_pushing, points_field, require_rope
from doojax.viewer.films import Film, film_of_prediction, film_of_trajectory, film_of_trial
from doojax.viewer.pictures import animate, contact_sheet, frames
from doojax.viewer.pouring import film_of_pour, film_of_pouring, holds_pouring
from doojax.viewer.recording import record

ENDINGS = (".png", ".gif", ".mp4", ".viser", ".html")
ON_SHEET = 12  # trajectories
LOOKED_AT = 512  # trajectories, for those that move most


def render(path: Path, /, *, out: Path, index: int | None = None) -> None:
    """Draw a data set, a prediction or a trial.

    A .png of a data set is a sheet of many trajectories, of a trial of arms what they did, of anything else
    its end. A .gif or .mp4 moves. An .html is a page to turn and play that needs nothing else; a .viser is
    the same for viser's own player.

    Args:
        path: a data set or a record (.npz).
        out: the file to write; its ending says what it is to be.
        index: of the trajectory or the prediction; by default those that move most, or the first prediction.

    Raises:
        FileNotFoundError: where there is nothing.
        ValueError: for another ending, something that cannot be drawn, or an index that does not exist.
    """
    if out.suffix not in ENDINGS:
        raise ValueError(f"{out} ends in {out.suffix!r}, expected one of {', '.join(ENDINGS)}")
    dataset = Dataset.open(path) if not path.is_file() else None
    if dataset is not None and holds_pouring(dataset):
        film = film_of_pouring(dataset, chosen_pour(dataset, index))
        out.parent.mkdir(parents=True, exist_ok=True)
        write(film, out)
        Console(stderr=True, soft_wrap=True).print(f"drew {film.title}: {out}", highlight=False, markup=False)
        return
    if dataset is not None:
        require_rope(dataset)
    if dataset is not None and out.suffix == ".png" and index is None:
        chosen = most_moving(dataset, ON_SHEET)
        out.parent.mkdir(parents=True, exist_ok=True)
        announce(f"drawing {path}")
        contact_sheet(dataset, chosen, out)
        what = f"{len(chosen)} of {len(dataset)} trajectories"
    else:
        shown = None if dataset else load_record(path)
        arms = isinstance(shown, TrialRecord) and "joints" in shown.replay and "arms" not in shown.about
        if isinstance(shown, TrialRecord) and arms and out.suffix == ".png":
            out.parent.mkdir(parents=True, exist_ok=True)
            strip(shown, out)
            Console(stderr=True, soft_wrap=True).print(f"drew {path}: {out}", highlight=False, markup=False)
            return
        film = film_of_trajectory(dataset, chosen_index(dataset, index)) if dataset else film_at(path, index)
        out.parent.mkdir(parents=True, exist_ok=True)
        announce(f"drawing {path}")
        write(film, out)
        what = film.title
    Console(stderr=True, soft_wrap=True).print(f"drew {what}: {out}", highlight=False, markup=False)


def chosen_index(dataset: Dataset, index: int | None) -> int:
    """An index that exists, by default of the trajectory that moves most."""
    if index is None:
        return most_moving(dataset, 1)[0]
    if not 0 <= index < len(dataset):
        raise ValueError(f"there is no trajectory {index}: {dataset.path} holds 0 to {len(dataset) - 1}")
    return index


def chosen_pour(dataset: Dataset, index: int | None) -> int:
    """An index that exists, by default of the trajectory that pours most."""
    if index is None:
        return int(np.nanargmax(dataset["volumes"][: min(len(dataset), LOOKED_AT)][:, -1, 0]))
    return chosen_index(dataset, index)


def film_at(path: Path, index: int | None) -> Film:
    """The film of a record."""
    shown = load_record(path)
    if isinstance(shown, TrialRecord):
        if index is not None:
            raise ValueError(f"{path} is one trial: leave --index out")
        return film_of_pour(shown) if shown.look.what == "container" else film_of_trial(shown)
    count = len(shown.start)
    if not 0 <= (index or 0) < count:
        raise ValueError(f"there is no prediction {index or 0}: {path} holds {count}, counted from 0")
    return film_of_prediction(shown, index or 0)


def write(film: Film, out: Path) -> None:
    """Write a film as what the ending of the file asks for."""
    if out.suffix == ".png":
        (pixels,) = frames(film, [float(film.states - 1)])
        Image.fromarray(pixels).save(out, optimize=True)
    elif out.suffix in (".gif", ".mp4"):
        animate(film, out)
    else:
        record(film, out)


def most_moving(dataset: Dataset, count: int) -> list[int]:
    """Some trajectories, in stored order: of the first of a data set, where tail or bodies travel most."""
    places = dataset[points_field(dataset)][: min(len(dataset), LOOKED_AT)]
    tails = places if holds_pushing(dataset) else places[:, :, :1]
    travelled = np.nan_to_num(np.linalg.norm(np.diff(tails, axis=1), axis=-1).sum((1, 2)))
    return sorted(np.argsort(-travelled, kind="stable")[:count].tolist())
