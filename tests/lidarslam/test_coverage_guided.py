"""What a coverage-guided fuzzer finds: every input of a decoder ends in a result or an error."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "fuzz_decoders.py"
DECODERS = ("ply", "pcd", "npy", "mcap", "bag", "db3", "message", "tum", "yaml", "summary", "about")


@pytest.mark.parametrize("decoder", DECODERS)
def test_no_input_of_a_decoder_ends_otherwise(decoder: str) -> None:
    pytest.importorskip("atheris", reason="needs the extra fuzz")
    command = [sys.executable, str(SCRIPT), decoder, "--runs", "2000", "--seconds", "60"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "DONE" in ended.stderr
