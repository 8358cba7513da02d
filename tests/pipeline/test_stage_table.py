"""The stage table and what follows from it: order, what is needed, what is stale."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

from polmvs.config import Options, plain_options
from polmvs.pipeline.run_folder import HERE
from polmvs.pipeline.stage_table import (
    StageSpec,
    in_order,
    stage_table,
    with_dependent,
    with_needed,
    written_names,
)
from polmvs.polarization.kinds import AngleModel

PPA, OPA, TILTED = AngleModel.PPA, AngleModel.OPA, AngleModel.TILTED
# Which stages are done, not what they find.
NOT_DECIDING = {"export.mesh", "export.colmap"}


def names(specs) -> list[str]:
    return [spec.name for spec in specs]


def toy(name: str, reads: str = "", writes: str = "") -> StageSpec:
    """A stage that reads and writes files of one letter."""
    return StageSpec(
        name=name,
        command="toy",
        reads=tuple(map(Path, reads)),
        writes=tuple(map(Path, writes)),
        work=lambda run: None,
        result=int,
    )


def test_order_follows_from_what_is_read() -> None:
    table = [toy("c", "xy", "z"), toy("b", "x", "y"), toy("a", "", "x"), toy("d", "", "w")]
    assert names(in_order(table)) == ["a", "b", "c", "d"]


def test_circle_is_refused() -> None:
    with pytest.raises(ValueError, match=r"in a circle: \['a', 'b'\]"):
        in_order([toy("a", "y", "x"), toy("b", "x", "y")])


def test_what_is_needed_and_what_is_stale() -> None:
    table = [toy("a", "", "x"), toy("b", "x", "y"), toy("c", "x", "z"), toy("d", "y", "w")]
    assert names(with_needed(["d"], table)) == ["a", "b", "d"]
    assert names(with_needed(["c", "b"], table)) == ["a", "b", "c"]
    assert names(with_dependent(["b"], table)) == ["b", "d"]
    assert names(with_dependent(["a"], table)) == ["a", "b", "c", "d"]
    assert names(with_dependent([], table)) == []


def test_names_results_and_files_are_each_of_one_stage() -> None:
    table = stage_table()
    assert len(set(names(table))) == len(table)
    results = [(spec.result, spec.angle_model) for spec in table]
    assert len(set(results)) == len(table)
    written = [path for spec in table for path in spec.writes]
    assert len(set(written)) == len(written)
    for path in written:  # nor does one write into a folder of another
        assert not any(other in path.parents for other in written)
    for spec in table:
        assert len(set(spec.reads)) == len(spec.reads), spec.name


def test_everything_that_is_read_is_written_by_a_stage_before() -> None:
    written: set[Path] = set()
    for spec in stage_table():
        assert set(spec.reads) <= written, spec.name
        written.update(spec.writes)


def test_every_option_decides_a_stage() -> None:
    """One that is new and decides none would leave stale results with ``--resume``."""
    deciding = {path for spec in stage_table() for path in plain_options(Options(), spec.decides)}
    every = {
        f"{group.name}.{field.name}"
        for group in fields(Options)
        for field in fields(getattr(Options(), group.name))
    }
    assert every - deciding == NOT_DECIDING
    with pytest.raises(KeyError):
        plain_options(Options(), ["propagation.soup"])


def test_stale_stages_leave_other_models_alone() -> None:
    table = stage_table()
    assert names(with_dependent(["mesh_ppa"], table)) == ["mesh_ppa"]
    assert names(with_dependent(["densify_tilted"], table)) == [
        *("densify_tilted", "trust_tilted", "mesh_tilted", "dense_tilted", "evaluation")
    ]
    stale = names(with_dependent(["normals_ppa"], table))  # which the seeds are chosen by
    assert {"seeds", "sparse_cloud_opa", "densify_opa", "dense_ppa", "evaluation"} <= set(stale)
    assert not {"maps", "normals_opa", "normals_tilted"} & set(stale)
    assert set(names(with_dependent(["poses"], table))) == set(names(table)) - {"images", "sfm"}


def test_evaluation_of_some_models_does_not_need_the_others() -> None:
    table = stage_table((PPA,))
    assert "densify_opa" not in names(with_needed(["evaluation"], table))
    assert "evaluation" not in names(with_dependent(["densify_opa"], table))
    assert "evaluation" in names(with_dependent(["densify_opa"], stage_table()))


def test_maps_of_the_tilted_model_are_made_for_it_alone() -> None:
    table = stage_table()
    assert "maps_tilted" not in names(with_needed(["densify_opa", "densify_ppa"], table))
    assert "maps_tilted" in names(with_needed(["densify_tilted"], table))


def test_names_of_all_results() -> None:
    written = written_names()
    assert written[-1] == "run.json"
    assert {"images", "sparse", "maps", "maps_tilted", "tracks", "normals.ply"} <= set(written)
    assert {"ppa.ply", "views_opa", "tilted_mesh.ply", "dense", "metrics.json"} <= set(written)
    assert len(set(written)) == len(written)


def test_exports_are_what_the_options_ask_for() -> None:
    by_name = {spec.name: spec for spec in stage_table()}
    options = Options()
    assert by_name["mesh_ppa"].is_wanted(options)
    without = replace(options, export=replace(options.export, mesh=False))
    assert not by_name["mesh_ppa"].is_wanted(without)
    assert by_name["dense_ppa"].is_wanted(without)
    assert by_name["densify_ppa"].is_wanted(without)
    assert by_name["mesh_ppa"].writes == (HERE.mesh(PPA),)
