"""What libraries print on stderr by themselves."""

import os

from polmvs.unprinted import unprinted


def test_what_a_library_writes_by_itself_is_not_shown(capfd, caplog):
    with caplog.at_level("DEBUG", logger="polmvs"), unprinted("Open3D"):
        os.write(2, b"bad average roots: 4")
    assert capfd.readouterr().err == ""
    assert caplog.messages == ["Open3D: bad average roots: 4"]
    os.write(2, b"mine")
    assert capfd.readouterr().err == "mine"
