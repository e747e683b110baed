"""Every test that docs/robustness.md names is there."""

import re
from pathlib import Path

TESTS = Path(__file__).parent
TABLE = TESTS.parent / "docs" / "robustness.md"
# A file, a test of it, or both; a test alone is of the file named last.
NAMED = re.compile(r"`([\w/]+\.py)?(?:::(test_\w+))?`")


def test_the_tests_that_the_fault_table_names_are_there() -> None:
    rows = [row for row in TABLE.read_text(encoding="utf-8").splitlines() if row.startswith("| ")]
    missing, named, file = [], 0, ""
    for row in rows:
        for match in NAMED.finditer(row.rsplit("|", 2)[1]):
            if not any(match.groups()):
                continue
            file, test = match[1] or file, match[2]
            source = TESTS / file
            named += 1
            if not source.is_file() or (test and f"def {test}(" not in source.read_text(encoding="utf-8")):
                missing.append(match[0])
    assert not missing
    assert named > 50
