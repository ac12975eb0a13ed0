"""An augmentation in the page: beside its original or the nearest one, and as it was searched for."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from jaxtyping import Float

from doojax.augmentation.replay import Replayed, original_of, replayed
from doojax.datasets import Dataset
from doojax.datasets.diversity import evenly, nearest_distances, positions
from doojax.experiments.drawing import Drawing
from doojax.experiments.trials.records import Look
from doojax.types import Verdict
from doojax.viewer import colours
from doojax.viewer.episodes import Episode, episode
from doojax.viewer.page import Page
from doojax.viewer.show import GHOST, between, show_rope

OWN, NEAREST, NOTHING = "its original", "the nearest original", "nothing"


class AugmentationView:
    """The controls of one augmented data set, and what they add to the scene."""

    def __init__(self, page: Page, dataset: Dataset, again: Callable[[], None]):
        """Controls where the page's next one goes; ``again`` draws what is shown once more."""
        gui = page.server.gui
        self._dataset, self._index = dataset, 0
        self.beside: int | None = None  # index of the row that is shown as a ghost
        self._ghost: Episode | None = None  # that row
        self._search: Replayed | None = None
        self._originals = evenly(np.flatnonzero(dataset["verdict"][:] == Verdict.ORIGINAL))
        self._facts = gui.add_markdown("")
        self._choice = gui.add_dropdown("Beside it", (OWN, NEAREST, NOTHING))
        self._button = gui.add_button("Search again", hint="Shows where the projection looked, step by step")
        self._step = gui.add_slider("Step", min=0, max=1, step=1, initial_value=0, visible=False)

        def load_again() -> None:
            self.load(self._index)
            again()

        def search() -> None:
            self._search = replayed(dataset, self._index)
            self._step.max, self._step.visible = len(self._search.transforms) - 1, True
            self._step.value = self._step.max
            again()

        self._choice.on_update(page.calling(load_again))
        self._button.on_click(page.calling(search))
        self._step.on_update(page.calling(again))

    def load(self, index: int) -> None:
        """Take up another row: its ghost, and what is known of it."""
        dataset, self._search = self._dataset, None
        verdict = Verdict(int(dataset["verdict"][index]))
        lines = [f"**{verdict.name.lower().replace('_', ' ')}**"]
        self._index, self.beside, chosen = index, None, self._choice.value
        self._step.visible = False
        self._button.visible = verdict != Verdict.ORIGINAL
        if verdict == Verdict.ACCEPTED:
            move, turn = np.split(dataset["transform"][index], 2)
            lines.append(f"moved {100 * np.linalg.norm(move):.1f} cm, turned {np.linalg.norm(turn):.2f} rad")
            gap, nearest = self._nearest(index)
            lines.append(f"nearest original: row {dataset.rows[nearest]}, {100 * gap:.1f} cm")
            if chosen == NEAREST:
                self.beside = nearest
        if verdict != Verdict.ORIGINAL:
            original = original_of(dataset, index)
            lines.append(f"made of row {dataset.rows[original]}")
            if chosen == OWN:
                self.beside = original
        self._ghost = None if self.beside is None else episode(dataset, self.beside)
        self._facts.content = "  \n".join(lines)

    def _nearest(self, index: int) -> tuple[float, int]:
        """How far (m) the nearest of at most 512 originals is, and its index."""
        own = positions(self._dataset, np.array([index]))
        gaps, numbers = nearest_distances(own, self._original_places)
        return float(gaps[0]), int(self._originals[numbers[0]])

    @cached_property
    def _original_places(self) -> Float[np.ndarray, "N T K 3"]:
        return positions(self._dataset, self._originals)

    def places(self, moment: float) -> tuple[np.ndarray, np.ndarray]:
        """Points, or bodies, and grippers where the search is, m; a search has to have been asked for."""
        if self._search is None:
            raise ValueError("nothing was searched for: press Search again first")
        points, grippers = self._search.places(int(self._step.value))
        return between(points, moment), between(grippers, moment)

    def show(self, drawing: Drawing, look: Look, moment: float) -> None:
        """Draw what stands beside the augmentation, and the step of its search."""
        drawn = {}
        if (one := self._ghost) is not None:
            drawn["beside"] = between(one.points, moment), between(one.grippers, moment), colours.CHOSEN
        if self._search is not None:
            drawn["search"] = *self.places(moment), colours.PREDICTION
        for name in ("beside", "search"):
            if name in drawn:
                points, grippers, colour = drawn[name]
                show_rope(drawing, name, points, grippers, look, colour=colour, opacity=GHOST)
            else:
                drawing.remove(name)
