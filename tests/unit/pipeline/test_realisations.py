"""Work in few processes, kept and continued."""

import math

import pytest

from rotaline.pipeline.observer import Silent
from rotaline.pipeline.realisations import WorkPlan


def kept(tmp_path, jobs=1):
    return WorkPlan(jobs, tmp_path, Silent())


def test_results_are_in_the_order_of_the_units_in_any_number_of_processes(tmp_path):
    units = {f"{k}": float(k * k) for k in range(7)}
    assert WorkPlan(1, None, Silent()).do("roots", math.sqrt, units) == [0, 1, 2, 3, 4, 5, 6]
    assert kept(tmp_path, jobs=2).do("roots", math.sqrt, units) == [0, 1, 2, 3, 4, 5, 6]


def test_what_was_finished_before_an_interruption_is_not_done_again(tmp_path):
    done = []

    def work(value):
        if value == 2 and len(done) < 3:
            raise KeyboardInterrupt
        done.append(value)
        return 10 * value

    units = {"a": 0, "b": 1, "c": 2, "d": 3}
    with pytest.raises(KeyboardInterrupt):
        kept(tmp_path).do("tens", work, units)
    assert done == [0, 1]
    done.append("again")
    assert kept(tmp_path).do("tens", work, units) == [0, 10, 20, 30]
    assert done == [0, 1, "again", 2, 3]


def test_other_arguments_take_the_place_of_the_kept_result(tmp_path):
    assert kept(tmp_path).do("roots", math.sqrt, {"0.5 of 1": 4.0}) == [2.0]
    assert kept(tmp_path).do("roots", math.sqrt, {"0.5 of 1": 9.0}) == [3.0]
    assert len(list((tmp_path / "realisations").iterdir())) == 1


def test_a_damaged_result_is_made_again(tmp_path):
    kept(tmp_path).do("roots", math.sqrt, {"a": 4.0})
    (path,) = (tmp_path / "realisations").iterdir()
    path.write_bytes(b"no record")
    assert kept(tmp_path).do("roots", math.sqrt, {"a": 4.0}) == [2.0]


def test_every_unit_is_counted_also_those_that_were_kept(tmp_path):
    class Counter(Silent):
        count = 0

        def work(self, label, total):
            from contextlib import nullcontext

            def one():
                self.count += 1

            return nullcontext(one)

    for _ in range(2):
        counter = Counter()
        WorkPlan(1, tmp_path, counter).do("roots", math.sqrt, {"a": 1.0, "b": 2.0})
        assert counter.count == 2
