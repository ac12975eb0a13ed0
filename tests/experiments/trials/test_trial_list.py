"""Lists of trials: what is listed is not read again, and what is not is read from its record."""

import pytest

from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.trial_list import LIST, line_of, list_trials, note_trial

from .test_why import CAUGHT


def test_listed_and_unlisted_trials_come_by_number_and_the_later_line_counts(tmp_path):
    for number in (0, 1, 3):
        save_record(tmp_path / f"{number:05d}.npz", CAUGHT)
    for number in (3, 1, 7):
        note_trial(tmp_path, line_of(CAUGHT, number))
    with (tmp_path / LIST).open("a") as file:
        file.write(
            (tmp_path / LIST).read_text().splitlines()[0].replace('"actions": 3', '"actions": 5') + "\n"
        )
        file.write('{"trial": 0, "rea')  # it is being written
    found = list(list_trials(tmp_path))
    assert [line.trial for line in found] == [0, 1, 3]  # 7 has no record any more
    assert [line.actions for line in found] == [3, 3, 5]
    assert found[0] == line_of(CAUGHT, 0)
    assert "touching box 1" in found[0].why and found[0].error_m == 0.42 and not found[0].reached


def test_what_follows_a_line_that_a_kill_cut_off_is_read(tmp_path):
    for number in (0, 1):
        save_record(tmp_path / f"{number:05d}.npz", CAUGHT)
        note_trial(tmp_path, line_of(CAUGHT, number))
    whole = (tmp_path / LIST).read_text()
    (tmp_path / LIST).write_text(whole[:-20])
    note_trial(tmp_path, line_of(CAUGHT, 1))
    assert (tmp_path / LIST).read_text() == whole
    assert [line.trial for line in list_trials(tmp_path)] == [0, 1]


def test_a_damaged_list_is_named(tmp_path):
    (tmp_path / LIST).write_text('{"trial": -1}\n')
    with pytest.raises(ValueError, match=r"trials.jsonl, line 1, is not a list of trials"):
        list(list_trials(tmp_path))
