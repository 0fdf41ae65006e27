# SPDX-License-Identifier: Apache-2.0
"""Poses on command lines, in each of their formats."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from shmmap_clients.shared_options import add_pose_format_option, add_pose_option, pose_from, pose_text

from shmmap import BadRequest


def read(text: str, *words: str) -> NDArray[np.float64]:
    parser = argparse.ArgumentParser()
    add_pose_option(parser, "--start-at", "where")
    add_pose_format_option(parser)
    return pose_from(parser.parse_args([f"--start-at={text}", *words]), "--start-at")


def test_angles_are_about_fixed_axes_as_in_ros() -> None:
    T = read("1,2,3,0.3,-0.2,2.5")
    assert T[:3, 3].tolist() == [1.0, 2.0, 3.0]
    # lower case: extrinsic, REP-103's "fixed axis roll, pitch, yaw about X, Y, Z"
    np.testing.assert_allclose(
        T[:3, :3], Rotation.from_euler("xyz", [0.3, -0.2, 2.5]).as_matrix(), atol=1e-12
    )


def test_quaternions_and_headings() -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 2.5])
    quaternion = ",".join(map(str, rotation.as_quat()))
    np.testing.assert_allclose(
        read(f"1,2,3,{quaternion}", "--pose-format", "tum"), read("1,2,3,0.3,-0.2,2.5"), atol=1e-12
    )
    np.testing.assert_allclose(read("-1,2,0.5", "--pose-format", "xyyaw"), read("-1,2,0,0,0,0.5"), atol=1e-12)


def test_another_format_is_named() -> None:
    with pytest.raises(
        BadRequest, match="--start-at: expected 6 numbers X,Y,Z,ROLL,PITCH,YAW, not 7"
    ) as error:
        read("1,2,3,0,0,0,1")
    assert error.value.hint == "X,Y,Z,QX,QY,QZ,QW is --pose-format tum"
    with pytest.raises(BadRequest, match="expected 3 numbers X,Y,YAW, not 6"):
        read("1,2,3,0,0,0", "--pose-format", "xyyaw")
    with pytest.raises(BadRequest, match="no rotation"):
        read("1,2,3,0,0,0,0", "--pose-format", "tum")


@pytest.mark.parametrize("text", ["", "1", "1,2", "1,2,3,4", "a,b,c", "1,2,nan", "1,2,3,0,0,inf"])
def test_what_is_no_pose_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        read(text)
    assert "expected a pose X,Y,Z,ROLL,PITCH,YAW" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["rpy", "tum"])
def test_a_printed_pose_can_be_given_again(name: str) -> None:
    for text in ("16.492,78.504,-3.673,0.3,-0.2,2.5", "-1,2,3,-3.1,1.5,-0.7", "0,0,0,0,0,0"):
        T = read(text)
        np.testing.assert_allclose(read(pose_text(T, name), "--pose-format", name), T, atol=2e-6)
    assert (
        pose_text(read("16.492,78.504,-3.673,0,0,0"), "rpy")
        == "16.492,78.504,-3.673,0.000000,0.000000,0.000000"
    )


def test_a_printed_heading_leaves_out_the_rest() -> None:
    assert pose_text(read("1,2,3,0.1,0.2,0.5"), "xyyaw") == "1.000,2.000,0.500000"
