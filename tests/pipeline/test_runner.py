"""What a run does with its stages: records, skips, does again, forgets; and what it reports."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from helpers import cut_after, record_of, refused, result_of, stages_of

from polmvs.colmap.models import read_model, write_model
from polmvs.config import (
    EvaluationOptions,
    FusionOptions,
    Options,
    PropagationOptions,
    RegionOptions,
    RunOptions,
    SfmOptions,
    to_plain,
)
from polmvs.errors import DataError, OptionError
from polmvs.io.clouds import read_cloud
from polmvs.normals.tracks import select_seeds
from polmvs.parallel import Workers
from polmvs.pipeline.jobs import compare
from polmvs.pipeline.record import Record, read_record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import Job, NoMonitor, Run, prepare_output
from polmvs.pipeline.stage_table import StageSpec, stage_table
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import SparseModel, some_tracks

INTRINSICS = (333.75, 333.75, 230.6475, 196.608)  # of the bundled capture
COARSE = PropagationOptions(stride_px=8, num_rounds=2)


@dataclass(frozen=True, kw_only=True)
class Text:
    """What a toy stage finds."""

    text: str


class Recorder(NoMonitor):
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.totals: dict[str, int | None] = {}
        self.steps: dict[str, int] = {}
        self.events: list[str] = []

    @contextmanager
    def stage(self, name: str, total: int | None) -> Iterator[Callable[[int], None]]:
        self.totals[name], self.steps[name] = total, 0

        def on_progress(count: int) -> None:
            self.steps[name] += count

        yield on_progress

    def finished(self, name: str, seconds: float, summary: str) -> None:
        self.events.append(f"{name}: {summary}")

    def skipped(self, name: str) -> None:
        self.events.append(f"{name} skipped")


def toy(name: str, reads: str, writes: str, **changes) -> StageSpec:
    """A stage that joins the files it reads, and adds its name."""

    def work(run) -> Text:
        root = run.run_folder.root
        text = "".join((root / path).read_text() for path in reads) + name
        (root / writes).write_text(text)
        run.on_progress(1)
        return Text(text=text)

    spec = StageSpec(
        name=name,
        command="toy",
        reads=tuple(map(Path, reads)),
        writes=(Path(writes),),
        work=work,
        result=Text,
    )
    return replace(spec, **changes)


@pytest.fixture
def make_run(demo_capture: Path, tmp_path: Path) -> Callable[..., Run]:
    """A run of toy stages; called again, it goes on."""
    capture = open_capture(demo_capture)
    folder = RunFolder(tmp_path / "out")
    folder.root.mkdir()

    def make(table, options: Options | None = None, monitor: NoMonitor | None = None) -> Run:
        record = Record()
        if folder.run_file.exists():
            record = read_record(folder, {spec.name: spec.result for spec in table})
        return Run(
            run_folder=folder,
            capture=capture,
            options=options or Options(),
            workers=Workers(1),
            monitor=monitor or NoMonitor(),
            table=table,
            given_model=None,
            record=record,
        )

    return make


def test_stages_are_recorded_skipped_and_told_of(make_run) -> None:
    table = [toy("a", "", "x"), toy("b", "x", "y", num_steps=lambda run: 1)]
    run = make_run(table)
    for spec in table:
        run.do(spec)
    assert (run.run_folder.root / "y").read_text() == "ab"
    monitor = Recorder()
    again = make_run(table, monitor=monitor)
    assert [stage.result.text for stage in again.record.stages] == ["a", "ab"]
    (run.run_folder.root / "x").write_text("c")  # the recorded stage is not done again
    for spec in table:
        again.do(spec)
    assert monitor.events == ["a skipped", "b skipped"]
    again.forget(["b"])
    assert not (run.run_folder.root / "y").exists()
    again.do(table[1])
    assert monitor.events[2:] == ["b: Text(text='cb')"]
    assert (monitor.totals, monitor.steps) == ({"b": 1}, {"b": 1})


def test_what_was_deleted_is_made_again_and_nothing_else(make_run, caplog) -> None:
    table = [toy("a", "", "x"), toy("b", "x", "y"), toy("c", "y", "z")]
    run = make_run(table)
    for spec in table:
        run.do(spec)
    (run.run_folder.root / "x").unlink()
    monitor = Recorder()
    again = make_run(table, monitor=monitor)
    again.forget(["c"])
    again.forget(["b"])
    with pytest.raises(DataError, match="its stage 'a' lost files, which 'b' reads"):
        again.do(table[1])
    for spec in table:
        again.do(spec)
    assert monitor.events == ["a: Text(text='a')", "b: Text(text='ab')", "c: Text(text='abc')"]
    (run.run_folder.root / "x").unlink()
    for spec in table:
        again.do(spec)
    assert monitor.events[3:] == ["a: Text(text='a')", "b skipped", "c skipped"]
    assert "x is gone, or part of it, and is made again" in caplog.text
    assert [stage.name for stage in make_run(table).record.stages] == ["a", "b", "c"]


def test_what_is_being_made_again_is_of_the_same_options(make_run) -> None:
    """A run that is stopped meanwhile does not go on with others: what was made of it is there."""
    table = [toy("a", "", "x", decides=("region",)), toy("b", "x", "y")]
    run = make_run(table)
    for spec in table:
        run.do(spec)
    (run.run_folder.root / "x").unlink()

    def stop(run) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_run(table).do(replace(table[0], work=stop))
    changed = Options(region=RegionOptions(min_dolp=0.4))
    with pytest.raises(OptionError, match="finished stage 'a'"):
        make_run(table, changed).require_same_options(["a", "b"])
    monitor = Recorder()
    again = make_run(table, monitor=monitor)
    again.require_same_options(["a", "b"])
    for spec in table:
        again.do(spec)
    assert monitor.events == ["a: Text(text='a')", "b skipped"]
    assert [stage.is_lost for stage in make_run(table).record.stages] == [False, False]


def test_a_folder_that_lost_a_file_is_made_again(make_run) -> None:
    names = ("cameras.bin", "images.bin")

    def work(run) -> Text:
        run.run_folder.sparse.mkdir()
        for name in names:
            (run.run_folder.sparse / name).write_text(name)
        return Text(text="model")

    spec = toy("a", "", "sparse", work=work)
    run = make_run([spec])
    run.do(spec)
    (run.run_folder.sparse / names[0]).write_text("damaged")
    (run.run_folder.sparse / names[1]).unlink()
    make_run([spec]).do(spec)
    assert tuple((run.run_folder.sparse / name).read_text() for name in names) == names


def test_input_of_other_content_is_not_taken_over(make_run, tmp_path: Path) -> None:
    """Nor is what is quickly done kept of it; an own workspace is left to the run to fill."""
    masks, truth = tmp_path / "masks", tmp_path / "gt"
    for folder in (masks, truth):
        folder.mkdir()
        (folder / "1.png").write_text("before")
    options = Options(
        region=RegionOptions(mask=masks),
        fusion=FusionOptions(workspace=tmp_path / "workspace"),
        evaluation=EvaluationOptions(gt=truth),
    )
    table = [
        toy("a", "", "x", decides=("region", "fusion")),
        toy("b", "x", "y", decides=("evaluation",), is_redone=True),
    ]
    run = make_run(table, options)
    for spec in table:
        run.do(spec)
    (tmp_path / "workspace").mkdir()
    (tmp_path / "workspace" / "filled").write_text("by the run")
    (truth / "1.png").write_text("behind")
    monitor = Recorder()
    again = make_run(table, options, monitor=monitor)
    again.require_same_options(["a", "b"])
    for spec in table:
        again.do(spec)
    assert monitor.events == ["a skipped", "b: Text(text='ab')"]
    (masks / "1.png").write_text("behind")
    with pytest.raises(OptionError, match="changed since the finished stage 'a'") as caught:
        make_run(table, options).require_same_options(["a"])
    assert caught.value.field == "region.mask"


def test_forgetting_takes_all_that_is_made_from_it(make_run) -> None:
    table = [toy("a", "", "x"), toy("b", "x", "y"), toy("c", "", "z")]
    run = make_run(table)
    for spec in table:
        run.do(spec)
    run.forget(["a"])
    assert [stage.name for stage in make_run(table).record.stages] == ["c"]
    assert not (run.run_folder.root / "x").exists()
    assert not (run.run_folder.root / "y").exists()
    assert (run.run_folder.root / "z").exists()


def test_what_is_quickly_done_is_done_again_when_it_begins(make_run) -> None:
    """Not before: a run that stops on the way keeps the earlier result and its record."""
    table = [
        toy("a", "", "x"),
        toy("b", "x", "y", decides=("evaluation",), is_redone=True),
    ]
    run = make_run(table)
    for spec in table:
        run.do(spec)
    before = run.run_folder.run_file.read_bytes()
    changed = replace(Options(), evaluation=replace(Options().evaluation, gt=Path("gt")))
    again = make_run(table, changed)
    again.do(table[0])
    assert run.run_folder.run_file.read_bytes() == before
    again.record.stages = again.record.stages[1:]  # what it reads is missing
    with pytest.raises(DataError, match="its stage 'a' is not finished, which 'b' reads"):
        again.do(table[1])
    assert again.record.stage("b") is not None
    assert (run.run_folder.root / "y").read_text() == "ab"
    again = make_run(table, changed)
    again.do(table[1])
    assert again.record.stage("b").options["evaluation.gt"] == str(Path("gt").absolute())
    other = [table[0], toy("c", "", "z"), replace(table[1], reads=(Path("x"), Path("z")))]
    third = make_run(other, changed)  # made from other files
    for spec in other:
        third.do(spec)
    assert third.record.stage("b").reads == ("x", "z")


def test_failing_stage_is_not_recorded(make_run) -> None:
    def fail(run) -> None:
        raise DataError("x", "is broken.")

    table = [toy("a", "", "x"), toy("b", "x", "y", work=fail)]
    run = make_run(table)
    run.do(table[0])
    with pytest.raises(DataError, match="is broken"):
        run.do(table[1])
    assert [stage.name for stage in make_run(table).record.stages] == ["a"]


# On the bundled capture


@pytest.fixture
def copy_of(demo_run: Path, tmp_path: Path):
    """A copy of the finished run, stopped after a stage."""

    def copy(last: str) -> Path:
        out = tmp_path / "out"
        shutil.copytree(demo_run, out)
        cut_after(out, last)
        return out

    return copy


@pytest.mark.slow
def test_a_damaged_map_is_healed_as_its_message_says(copy_of, demo_capture: Path, cli) -> None:
    """Its own stage is done again, and alone: the normals made from the map are."""
    out = copy_of("normals_ppa")
    path = min((out / "maps").glob("*.npy"))
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    err = refused(cli("normals", demo_capture, out, "--resume"))
    assert str(path) in err
    assert "Delete it and give --resume" in err
    path.unlink()
    assert cli("normals", demo_capture, out, "--resume", "--workers", 1)[0] == 0
    assert path.read_bytes() == whole


def test_resume_with_other_neighbours_does_not_take_over_the_surface(
    copy_of, demo_capture: Path, cli
) -> None:
    out = copy_of("densify_tilted")
    err = refused(cli("compare", demo_capture, out, "--resume", "--max-neighbors", 8), 2)
    assert "is 8 but the finished stage 'densify_opa'" in err
    assert "used 15" in err


@pytest.mark.slow
def test_all_models_clouds_flag_the_same_seeds(
    copy_of, demo_capture: Path, cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    def only_ten(tracks, normals, maps):
        seeds, is_seed = select_seeds(tracks, normals, maps)
        ten = replace(
            seeds,
            points_in_world=seeds.points_in_world[:10],
            normals_in_world=seeds.normals_in_world[:10],
            sigma=seeds.sigma[:10],
        )
        return ten, is_seed & (np.cumsum(is_seed) <= 10)

    monkeypatch.setattr("polmvs.pipeline.stages.seeds.select_seeds", only_ten)
    out = copy_of("maps_tilted")
    for model in AngleModel:
        flags = ("--model", model, "--workers", 1, "--resume")
        assert cli("normals", demo_capture, out, *flags)[0] == 0
    assert result_of(out, "seeds")["num_seeds"] == 10
    clouds = [read_cloud(RunFolder(out).sparse_cloud(model)) for model in AngleModel]
    for cloud in clouds:
        assert cloud.scalars["seed"].sum() == 10
        np.testing.assert_array_equal(cloud.scalars["seed"], clouds[0].scalars["seed"])


@pytest.mark.slow
def test_evaluation_of_other_models_is_done_again(
    demo_run: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    models = "textbook-opa,opa"
    status, text, _ = cli("compare", demo_capture, out, "--resume", "--models", models)
    assert status == 0
    assert "tilted" not in text.splitlines()[0]
    models = json.loads((out / "metrics.json").read_text())["models"]
    assert set(models) == {"textbook-opa", "opa"}
    assert (out / "tilted.ply").exists()
    # What polmvs adds to OPA keeps its surface from following phases that perspective turned.
    textbook, opa = (models[name]["truth"]["cloud"] for name in ("textbook-opa", "opa"))
    assert textbook["f_score"][0] < 0.5 * opa["f_score"][0]
    assert textbook["normal_mean_deg"] > opa["normal_mean_deg"]


def some_views(model: SparseModel, num: int) -> SparseModel:
    """A model in which the last views have no pose."""
    tracks = model.tracks
    kept = tracks.obs_view < num
    tracks = replace(
        tracks,
        obs_track=tracks.obs_track[kept],
        obs_view=tracks.obs_view[kept],
        obs_xy=tracks.obs_xy[kept],
    )
    seen = np.bincount(tracks.obs_track, minlength=len(tracks.point3D_ids)) > 1
    lost = tuple(view.name for view in model.views[num:])
    return replace(
        model, views=model.views[:num], tracks=some_tracks(tracks, seen), unregistered=lost
    )


class Snapshots(Recorder):
    """Looks at the files of the run folder, and at the options that are read, stage by stage."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root = root
        self.changed: dict[str, set[Path]] = {}
        self.options_read: dict[str, set[str]] = {}
        self.now: str | None = None

    def files(self) -> dict[Path, tuple[int, int]]:
        found = {}
        for path in self.root.rglob("*"):
            if path.is_file():
                with suppress(FileNotFoundError):
                    found[path] = (path.stat().st_mtime_ns, path.stat().st_ino)
        return found

    @contextmanager
    def stage(self, name: str, total: int | None) -> Iterator[Callable[[int], None]]:
        before = self.files()
        self.options_read[name], self.now = set(), name
        with super().stage(name, total) as on_progress:
            yield on_progress
        self.now = None
        after = self.files()
        changed = {path for path in before | after if before.get(path) != after.get(path)}
        self.changed[name] = {path.relative_to(self.root) for path in changed}


@pytest.mark.slow
def test_stages_keep_to_their_entries(
    demo_run: Path, demo_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with unregistered views: files that are written, options that are read, totals."""
    sparse, out = tmp_path / "sparse", tmp_path / "out"
    write_model(some_views(read_model(demo_run / "sparse"), 6), sparse)
    monitor = Snapshots(out)
    options = Options(sfm=SfmOptions(sparse=sparse), propagation=COARSE)
    for group in fields(Options):
        watch(getattr(options, group.name), group.name, monitor, monkeypatch)
    job = Job(
        capture=demo_capture,
        out=out,
        options=options,
        run_options=RunOptions(workers=1),
        monitor=monitor,
    )
    outcome = compare(job, (AngleModel.PPA, AngleModel.TILTED))
    assert outcome.comparison is not None
    assert (outcome.comparison.sparse.num_views, len(outcome.comparison.models)) == (6, 2)
    specs = {spec.name: spec for spec in stage_table()}
    assert list(monitor.changed) == stages_of(out)
    for name, changed in monitor.changed.items():
        spec = specs[name]
        assert changed, name
        for path in changed:
            assert {path, *path.parents} & set(spec.writes), (name, path)
        declared = set(spec.decides)
        for read in monitor.options_read[name]:
            assert {read, read.partition(".")[0]} & declared, (name, read)
    assert monitor.totals["maps"] == 6
    for name, total in monitor.totals.items():
        if total is not None:
            assert monitor.steps[name] == total, name
    # Whatever a stage wrote is known to be a run's own.
    assert prepare_output(RunFolder(out), overwrite=True, resume=False) == Record()
    assert list(out.iterdir()) == []


def watch(options, group: str, monitor: Snapshots, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tell of every option of a group that is read while a stage works."""
    names = {field.name for field in fields(options)}

    def read(self, name: str):
        # Not those of other objects: an algorithm may have defaults of its own.
        if self is options and name in names and monitor.now is not None:
            monitor.options_read[monitor.now].add(f"{group}.{name}")
        return object.__getattribute__(self, name)

    monkeypatch.setattr(type(options), "__getattribute__", read, raising=False)


def test_results_in_the_record_are_those_of_the_job(demo_run: Path) -> None:
    run_folder = RunFolder(demo_run)
    record = read_record(run_folder, {spec.name: spec.result for spec in stage_table()})
    assert to_plain(record) == json.loads(run_folder.run_file.read_text())
    assert record_of(demo_run)["stages"][1]["result"]["num_views"] == 10
