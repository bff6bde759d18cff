"""What a run says while it works, where no terminal is."""

import io
import re

import pytest
from rich.console import Console

from jaxdeconf.pipeline.progress import Reporter


@pytest.mark.parametrize("color", [{}, {"FORCE_COLOR": "1"}])
def test_a_log_has_a_line_a_stage_with_its_time_and_loss_as_it_ends(color):
    """Plain and never repainted, whatever is forced."""
    log = io.StringIO()
    reporter = Reporter(Console(file=log, width=20, _environ=color))
    with reporter.bar("clone [Masked]", 100) as bar:
        for done in range(100):
            bar.update(done, f"loss {100 - done}, :smile: as wide as it needs to be")
        assert log.getvalue() == ""
    words = r"clone \[Masked\]: \d+\.\d s, loss 1, :smile: as wide as it needs to be\n"
    assert re.fullmatch(words, log.getvalue())
    with reporter.bar("mask", 1) as bar:
        bar.update(1, "")
    assert re.fullmatch(words + r"mask: \d+\.\d s\n", log.getvalue())


def test_stages_that_go_on_at_a_time_have_a_bar_each():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    reporter = Reporter(Console(file=screen, width=100, force_terminal=True))
    for _ in range(2):
        with reporter.bar("first", 10) as one, reporter.bar("second", 10) as other:
            one.update(10, "loss 1")
            other.update(5, "loss 2")
    last = screen.getvalue().split("first")[-1]
    assert re.search("10/10 .*loss 1", last)
    assert re.search("second .* 5/10 .*loss 2", last)


def test_a_stage_that_does_not_end_is_not_said_to():
    log = io.StringIO()
    with pytest.raises(ZeroDivisionError), Reporter(Console(file=log)).bar("mask", 1):
        raise ZeroDivisionError
    assert log.getvalue() == ""
