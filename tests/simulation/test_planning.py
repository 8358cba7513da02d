"""The plan of a part: table, plot and recommendation, of trials whose results are given."""

from dataclasses import replace

import pytest

from polmvs.errors import OptionError
from polmvs.io.images import decode_image
from polmvs.polarization.kinds import AngleModel
from polmvs.simulation import planning
from polmvs.simulation.options import LightName, PathOptions, PlanOptions, Simulation
from polmvs.simulation.trial import MODEL, TrialResult

OPTIONS = PlanOptions(view_counts=(20, 8), lights=(LightName.EVEN, LightName.STUDIO))


def given_trial(name, mesh, folder, simulation):
    """Better with views, and under the studio's light."""
    assert mesh == "dome"
    good = simulation.path.views >= 20 or simulation.lighting.light is LightName.STUDIO
    share = 0.97 if good else 0.6
    folder.mkdir(parents=True)
    return TrialResult(
        name=name,
        views=simulation.path.views,
        posed=simulation.path.views,
        points=1000,
        completeness=(share, share),
        f_score=(share, share),
        normal_median_deg=0.5,
    )


def test_plan_takes_the_fewest_views_that_suffice(tmp_path, monkeypatch):
    monkeypatch.setattr(planning, "run_trial", given_trial)
    plan = planning.make_plan("dome", tmp_path / "plan", Simulation(), OPTIONS)
    assert MODEL is AngleModel.PPA
    assert [one.trial.views for one in plan.trials] == [8, 20, 8, 20]
    assert plan.recommendation.startswith("Take 8 views under studio light")
    assert plan.recommendation in (tmp_path / "plan" / "plan.md").read_text()
    plot = decode_image("plan.png", (tmp_path / "plan" / "plan.png").read_bytes())
    assert plot.shape[1] > 800
    # Finished trials are kept; those of other options are others.
    monkeypatch.setattr(planning, "run_trial", None)
    assert (
        planning.make_plan("dome", tmp_path / "plan", Simulation(), OPTIONS).trials == plan.trials
    )
    other = Simulation(path=PathOptions(roll=5.0))
    with pytest.raises(TypeError):  # there is nothing to run them with
        planning.make_plan("dome", tmp_path / "plan", other, OPTIONS)


def test_where_nothing_works_nothing_is_recommended():
    poor = TrialResult(name="x", views=8, f_score=(0.0, 0.1), completeness=(0.0, 0.1))
    trials = [planning.PlannedTrial(light=LightName.EVEN, trial=poor)]
    assert planning.recommend(trials).startswith("None of these suffices")
    trials.append(planning.PlannedTrial(light=LightName.EVEN, trial=replace(poor, views=20)))
    assert planning.recommend(trials).startswith("None of these suffices")


def test_given_cameras_are_no_plan(tmp_path):
    options = Simulation(path=PathOptions(cameras=tmp_path))
    with pytest.raises(OptionError) as found:
        planning.make_plan("dome", tmp_path / "plan", options, OPTIONS)
    assert found.value.field == "path.cameras"
