"""Every interlock, limit and rule of the board, broken in turn, is caught."""

from __future__ import annotations

import pytest
from mutation import caught_by, limit, mutants, score, source

from muxjax.hardware import virtual_board


def test_the_board_as_it_is_breaks_nothing(muxarm):
    assert caught_by(muxarm) is None


@pytest.mark.parametrize(
    "mutant",
    [
        limit(virtual_board, "SEQUENCE_WINDOW", 17),
        source("virtual_board:VirtualBoard._estop", "self.faults |= Fault.ESTOP", "pass"),
    ],
    ids=lambda m: m.name,
)
def test_a_mutant_is_caught_and_mended(muxarm, mutant):
    with mutant.broken():
        assert caught_by(muxarm) is not None
    assert caught_by(muxarm) is None


def test_a_mutant_that_fits_nowhere_is_noticed():
    stale = source("virtual_board:VirtualBoard._estop", "self.gone()", "pass")
    with pytest.raises(LookupError, match="0 places read"), stale.broken():
        pass


def test_every_check_has_its_mutant():
    names = [m.name for m in mutants()]
    assert len(names) == len(set(names))
    assert len([n for n in names if " without " in n]) > 50


@pytest.mark.slow
def test_every_mutant_is_caught():
    caught, survived = score()
    assert survived == []
    assert len(caught) == len(mutants())
