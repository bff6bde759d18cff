"""Lines of code, without blanks, docstrings and comments: `python -m benchmarks.lines`.

The method is every room but the harness, which are those that know files or screens, and the
theory, whose experiments nothing of the method needs.
"""

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "jaxdeconf"
HARNESS = ("formats", "pipeline", "sweep", "owndata", "report", "commands")
_SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def lines(source: str) -> int:
    """Lines of a module's source on which anything stands that is code."""
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _SILENT and token.string:
            code |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            code -= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    return len(code)


def main() -> None:
    """Prints the lines of every room, and the sums."""
    rooms: Counter[str] = Counter()
    for file in PACKAGE.rglob("*.py"):
        rooms[file.relative_to(PACKAGE).parts[0]] += lines(file.read_text(encoding="utf-8"))
    for room, count in sorted(rooms.items()):
        print(f"{count:6}  {room}")
    harness, theory = sum(rooms[room] for room in HARNESS), rooms["theory"]
    method = rooms.total() - harness - theory
    print(f"{method:6}  the method\n{harness:6}  the harness\n{theory:6}  the theory")


if __name__ == "__main__":
    main()
