"""Fixtures of several tests of signals."""

import pytest


@pytest.fixture
def write(tmp_path):
    """Write a text file."""

    def to_file(content, name="pump.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return to_file
