"""What a bench says while it runs."""

from doojax.benchmarks.stages import stages


def test_each_part_is_announced_before_it_begins(capsys):
    seen = []
    for item in stages("toy", [("first", 1), ("second", 2)]):
        seen.append((item, capsys.readouterr().err))
    assert seen[0] == (1, "toy 1/2, after 0.0 min: first\n")
    assert seen[1] == (2, "toy 2/2, after 0.0 min: second\n")
