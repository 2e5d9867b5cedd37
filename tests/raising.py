"""What tests expect of an error: its code, and facts that its words must hold; never the words themselves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rille.stages.core.errors import RilleError


@contextmanager
def raises(code: str, *facts: str) -> Iterator[pytest.ExceptionInfo[RilleError]]:
    """Expect an error with this code; ``facts`` are names and values that its line must tell."""
    with pytest.raises(RilleError) as caught:
        yield caught
    told = f"{caught.value.code}: {caught.value}"
    assert caught.value.code == code, told
    assert not [fact for fact in facts if fact not in str(caught.value)], told
