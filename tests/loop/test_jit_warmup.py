"""What is said to need the compiler, and what is not."""

import pytest

from projservo_cli.control import FUNCTIONS
from projservo_cli.geometry import jit
from projservo_cli.laws import CODES
from projservo_cli.loop import jit_notice
from tests.conftest import INTERPRETED


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled: NUMBA_DISABLE_JIT is set")
def test_a_law_without_machine_code_is_announced_though_others_have_theirs(tmp_path, monkeypatch):
    for module in (jit_notice, jit):
        monkeypatch.setattr(module, "CACHE_FOLDER", tmp_path)
    assert jit_notice.compilation() == "compiling kernels, once"
    code = FUNCTIONS[CODES["direct_two"]].py_func.__code__
    (tmp_path / f"__init__.{code.co_name}-{code.co_firstlineno}.py311.nbi").touch()
    for names in ((), ("direct_two", "direct_three_track"), ("module:Class", "")):
        assert jit_notice.compilation(names) == ""
    assert jit_notice.compilation(("direct_two", "exact_track")) == "compiling kernels, once"
