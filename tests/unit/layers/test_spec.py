# SPDX-License-Identifier: Apache-2.0
"""Layer specs: one canonical form, everything else refused with a hint."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.errors import BadRequest
from shmmap.layers.spec import canonical_layer, canonical_layers, parse_layer


@pytest.mark.parametrize(
    ("text", "canonical"),
    [
        ("points", "points"),
        (" points() ", "points"),
        ("ndt(2)", "ndt(leaf=2.0)"),
        ("ndt( leaf = 2.0 , min_points=6)", "ndt(leaf=2.0)"),
        ("ndt(min_points=10,leaf=1)", "ndt(leaf=1.0,min_points=10)"),
        ("ndt(2, 10)", "ndt(leaf=2.0,min_points=10)"),
        ("ndt(leaf=2e0,min_points=6.0)", "ndt(leaf=2.0)"),
        ("voxel(leaf=.5)", "voxel(leaf=0.5)"),
        ("voxel(leaf_x=0.5,leaf_y=0.5,leaf_z=0.5)", "voxel(leaf=0.5)"),
        ("voxel(leaf_z=.25,leaf_x=0.5,leaf_y=0.5)", "voxel(leaf_x=0.5,leaf_y=0.5,leaf_z=0.25)"),
        ("ndt(leaf=2.0,of=voxel(0.1))", "ndt(leaf=2.0,of=voxel(leaf=0.1))"),
        ("ndt(of=points,leaf=2)", "ndt(leaf=2.0)"),
    ],
)
def test_canonical_forms(text: str, canonical: str) -> None:
    assert canonical_layer(text) == canonical
    assert canonical_layer(canonical) == canonical


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "cut short"),
        ("nonsense", "ndt(leaf,min_points=6)"),
        ("nonsense", "voxel("),
        ("ndtt(2)", "did you mean 'ndt'?"),
        ("ndt", "needs leaf"),
        ("ndt(leaf=0)", "out of range"),
        ("ndt(leaf=-1)", "out of range"),
        ("ndt(leaf=1e400)", "finite"),
        ("ndt(leaf=2,min_points=2.5)", "whole"),
        ("ndt(leaf=2,min_points=1)", "out of range"),
        ("ndt(leaf=2,leaf=2)", "twice"),
        ("ndt(2,leaf=2)", "twice"),
        ("ndt(2,6,7)", "too many"),
        ("ndt(2", "cut short"),
        ("ndt(2))", "after its end"),
        ("ndt(2) x", "after its end"),
        ("ndt(edge=2)", "no parameter 'edge'"),
        ("ndt(leaf=two)", "number"),
        ("ndt(leaf=2;1)", "';'"),
        ("ndt(leaf=nan)", "number"),
        ("voxel", "needs leaf"),
        ("voxel(leaf=1,leaf_x=1)", "not both"),
        ("voxel(leaf_x=1,leaf_y=1)", "needs leaf"),
        ("voxel(1,of=ndt(2))", "no points"),
        ("points(of=voxel(1))", "of the source"),
        ("ndt(1,of=voxel(1,of=voxel(1,of=voxel(1,of=points))))", "more than"),
        ("ndt(1,of=voxel(1),of=voxel(1))", "twice"),
        ("ndt(" + "0" * 300 + "2)", "characters"),
    ],
)
def test_refusals_say_what_is_wrong(text: str, says: str) -> None:
    with pytest.raises(BadRequest) as caught:
        canonical_layer(text)
    assert says in str(caught.value)


def test_several_layers() -> None:
    assert canonical_layers(["ndt(2)", "points", "ndt(leaf=2.0)"]) == ("ndt(leaf=2.0)", "points")
    with pytest.raises(BadRequest):
        canonical_layers([])


@given(st.text(alphabet="points voxelndt(=,).0123456789_-e", max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        spec = parse_layer(text)
    except BadRequest:
        return
    assert parse_layer(str(spec)) == spec
