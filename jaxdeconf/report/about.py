"""The end of every page: what a run took, with what it was made, and its config."""

from collections.abc import Iterator, Mapping

from jaxdeconf.owndata.results import Found
from jaxdeconf.pipeline.results import Results
from jaxdeconf.pipeline.theory import Theory
from jaxdeconf.report import page, words


def about(
    found: Results | Found | Theory, more: Mapping[str, str] | None = None, note: str = ""
) -> Iterator[str]:
    """The tables; `more` beside the versions and the memory, and a note below."""
    seconds = {**found.seconds, "total": sum(found.seconds.values())}
    yield page.table(["stage", "seconds"], [[stage, f"{s:.1f}"] for stage, s in seconds.items()])
    made = {**found.versions, "peak memory": f"{found.peak_memory_mb:.0f} MB", **(more or {})}
    yield page.table(["made with", ""], list(made.items()), note, "words")
    fields = [[name, words.shown(value)] for name, value in words.leaves(found.config)]
    yield page.folded("Config", page.table(["field", "value"], fields, kind="words"))
