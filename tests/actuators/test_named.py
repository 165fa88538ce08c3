"""Names of actuators and families, and whatever else may be written for an actuator."""

import dataclasses
import json
import re
import sys

import pytest
from hypothesis import given

import codrl_mj
from codrl_mj.actuators import (
    FAMILIES,
    IDEAL,
    NAMED,
    Actuator,
    ActuatorModel,
    CurrentLoop,
    Lag,
    Motor,
    Supply,
    TorqueSpeed,
    actuator_from_mapping,
    actuator_over,
    check_same_family,
    find_family,
    label_of,
    labelled,
    mapping_of,
    name_of,
    named_mapping,
    resolve,
)
from codrl_mj.fields import real
from codrl_mj.tasks import OURS, TASKS, named_actuator, resolve_actuators
from tests.actuators.strategies import of_every_family
from tests.tasks.faces import every_rebuilt

CARTPOLE = TASKS["cartpole"]


@dataclasses.dataclass(frozen=True)
class Mine(ActuatorModel):
    """A family of somebody else's."""

    family = "mine"
    strength: float = real(2.0, above=0.0)

    @staticmethod
    def advance(parameters, timestep, state, inputs):  # noqa: ARG004
        return state, parameters.strength * inputs.desired_torque, state


MINE = Mine(3.0)

# arXiv 2507.00268, Experimental Results: kP, kI, kD, kFF, arm
PAPER_GAINS = {
    "pendulum": (1.0, 20.0, 1e-6, 0.0, 1.0),
    "mountain_car": (1.0, 1.0, 1e-2, 0.0, 1.0),
    "mountain_car_continuous": (0.1, 10.0, 1e-3, 0.0, 1.0),
    "acrobot": (1.0, 10.0, 1e-6, 0.0, 1.0),
    "cartpole": (4.3, 1.0, 1e-6, 0.6, 0.15),
}


def test_every_task_of_the_papers_has_its_actuator():
    assert all(len(task.paper) == len(task.motors) for task in OURS)


@every_rebuilt
def test_the_paper_actuator_has_the_papers_motor_and_gains(task):
    kp, ki, kd, kff, arm = PAPER_GAINS[task]
    motor = Motor(resistance=1.0, inductance=0.1, torque_constant=1.0, back_emf_constant=1.0, arm_radius=arm)
    assert named_actuator("paper", task) == Actuator(motor, CurrentLoop(kp, ki, kd, kff, max_voltage=24.0))


@every_rebuilt
def test_the_weak_actuators_differ_from_the_papers_in_their_gains_only(task):
    motor = TASKS[task].paper[0].motor
    assert named_actuator("weak", task) == Actuator(motor, CurrentLoop(kp=1.0, ki=1.0))
    assert named_actuator("weaker", task) == Actuator(motor, CurrentLoop(kp=0.2, ki=0.2))


@every_rebuilt
def test_the_open_loop_actuator_feeds_nothing_back_and_holds_the_reference_at_rest(task):
    actuator = named_actuator("open_loop", task)
    loop = actuator.controller
    assert (loop.kp, loop.ki, loop.kd) == (0.0, 0.0, 0.0)
    assert loop.kff == actuator.motor.resistance  # u = R*i_ref is the voltage at which i_ref is at rest
    assert loop.bemf_compensation
    assert actuator.motor.inductance == 0.5
    assert actuator.motor.arm_radius == TASKS[task].paper[0].motor.arm_radius


@every_rebuilt
@pytest.mark.parametrize("name", NAMED)
def test_every_named_actuator_is_stable_at_the_step_it_is_used_with(name, task):
    actuator = named_actuator(name, task)
    assert (actuator is IDEAL) == (name == "ideal")
    actuator.check(TASKS[task].step_duration / TASKS[task].motor_inner_steps)


@pytest.mark.parametrize(
    ("wrong", "near"),
    [
        ("papr", "'paper'"),
        ("weakest", "'weaker'"),
        ("open-loop", "'open_loop'"),
        ("maxon-ec45", "'maxon-ec45-flat-339285' or 'maxon-ec45-flat-50w'"),
        ("Maxon-EC45-flat-50", "'maxon-ec45-flat-50w'"),
    ],
)
def test_an_unknown_name_suggests_the_nearest_and_no_others(wrong, near):
    with pytest.raises(ValueError, match="unknown actuator") as refused:
        named_actuator(wrong, "cartpole")
    said = f"unknown actuator '{wrong}': did you mean {near}? It can be module:NAME of your own"
    assert str(refused.value) == said


def test_a_name_like_none_lists_the_known_ones_and_says_who_lists_the_motors():
    with pytest.raises(ValueError, match="unknown actuator '12345': Known: ideal, paper, weak, weaker") as refused:
        resolve_actuators("12345", CARTPOLE)
    assert "torque_speed, the motors of `codrl-mj motor list`, or module:NAME of your own" in str(refused.value)
    assert "maxon" not in str(refused.value)


def test_resolve_takes_every_way_to_write_an_actuator():
    actuator = Actuator(Motor(resistance=2.0), CurrentLoop(kp=3.0))
    assert resolve_actuators(actuator, CARTPOLE) == (actuator,)
    assert resolve_actuators(actuator, CARTPOLE)[0] is actuator
    assert resolve_actuators(actuator.as_mapping(), CARTPOLE) == (actuator,)
    assert resolve_actuators("paper", CARTPOLE) == CARTPOLE.paper
    assert resolve_actuators("ideal", CARTPOLE) == (IDEAL,)
    assert resolve_actuators(None, CARTPOLE) == (IDEAL,)
    assert resolve_actuators([actuator], CARTPOLE) == (actuator,)
    for name, family in FAMILIES.items():
        assert resolve_actuators(name, CARTPOLE) == (family(),)


@pytest.mark.parametrize("value", [3, 1.5, ["paper", 3], [3], Motor()])
def test_resolve_refuses_anything_else(value):
    with pytest.raises(
        ValueError, match=r"actuator = .*must be a name .*, an actuator or a mapping|2 actuators for the 1"
    ):
        resolve_actuators(value, CARTPOLE)


def test_the_public_names_are_the_functions():
    assert codrl_mj.tasks.named_actuator is named_actuator
    assert codrl_mj.actuators.Actuator is Actuator


# -- several motors -----------------------------------------------------------------------------------------

PAIR = dataclasses.replace(
    CARTPOLE,
    name="pair",
    motors=("left", "right"),
    forces=((-10.0, -10.0), (10.0, 10.0)),
    paper=(Actuator(Motor(inductance=0.2)), Actuator(Motor(inductance=0.3))),
)


def test_every_motor_has_its_own_variation_of_its_own_actuator():
    for name, gain in (("weak", 1.0), ("weaker", 0.2)):
        loop = CurrentLoop(kp=gain, ki=gain)
        assert resolve_actuators(name, PAIR) == (
            Actuator(PAIR.paper[0].motor, loop),
            Actuator(PAIR.paper[1].motor, loop),
        )
    assert resolve_actuators(["paper", "weak"], PAIR)[0] == PAIR.paper[0]
    assert resolve_actuators(Lag(), PAIR) == (Lag(), Lag())


def test_too_few_and_too_many_are_refused_with_the_motors_names():
    for count in (1, 3):
        with pytest.raises(ValueError, match=f"{count} actuators for the 2 motors of pair: left, right"):
            resolve_actuators(["paper"] * count, PAIR)


def test_families_are_not_mixed():
    with pytest.raises(ValueError, match=r"actuators of several families \(Actuator, Lag\)"):
        resolve_actuators(["paper", Lag()], PAIR)
    assert check_same_family([Lag(0.1), Lag(0.2)]) is Lag


def test_a_task_without_a_papers_actuator_has_no_variations_of_it():
    alone = dataclasses.replace(CARTPOLE, paper=(), name="bare")
    for name in ("paper", "weak", "open_loop"):
        with pytest.raises(
            ValueError, match=rf"actuator = '{name}': .* of which bare has none; known are current_loop"
        ):
            resolve_actuators(name, alone)
    assert resolve_actuators("ideal", alone) == (IDEAL,)
    assert resolve_actuators("lag", alone) == (Lag(),)


# -- families -----------------------------------------------------------------------------------------------


@given(of_every_family)
def test_every_family_survives_its_mapping_and_json(actuator):
    mapping = actuator.as_mapping()
    assert actuator_from_mapping(mapping) == actuator
    assert actuator_from_mapping(json.loads(json.dumps(mapping))) == actuator
    saved = mapping_of(actuator)
    assert (saved is None) == (actuator == IDEAL)
    assert resolve(json.loads(json.dumps(saved)), None, "nobody") == actuator


def test_a_family_is_found_by_its_name_and_by_its_place():
    for name, family in FAMILIES.items():
        assert find_family(name) is family
        assert find_family(f"{family.__module__}:{family.__name__}") is family
        assert name == family.family
    assert find_family(f"{__name__}:Mine") is Mine


def test_somebody_elses_family_survives_its_mapping_though_its_name_is_not_known():
    mapping = json.loads(json.dumps(MINE.as_mapping()))
    assert mapping == {"family": f"{__name__}:Mine", "strength": 3.0}
    assert actuator_from_mapping(mapping) == MINE


def test_a_family_derived_from_ours_survives_its_mapping():
    derived = Actuator().commands()["voltage"].actuator
    assert actuator_from_mapping(json.loads(json.dumps(derived.as_mapping()))) == derived


def test_a_mapping_without_a_family_is_a_current_loop():
    assert actuator_from_mapping({"motor": {"resistance": 2.0}}) == Actuator(Motor(resistance=2.0))
    assert actuator_from_mapping({"family": "current_loop"}) == Actuator()


@pytest.mark.parametrize(("wrong", "near"), [("lagg", "lag"), ("torque-speed", "torque_speed"), ("idael", "ideal")])
def test_an_unknown_family_suggests_the_nearest(wrong, near):
    with pytest.raises(ValueError, match=f"unknown family '{wrong}': did you mean '{near}'"):
        actuator_from_mapping({"family": wrong})


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"family": "lag", "time_constnt": 1.0}, r"unknown actuator field time_constnt; did you mean time_constant\?"),
        ({"family": "lag", "motor": {}}, "unknown actuator field motor; known: time_constant, delay"),
        ({"family": "lag", "delay": -1.0}, r"Lag\.delay = -1\.0: must be a finite number >= 0"),
        ({"family": "torque_speed", "max_torque": 0}, r"TorqueSpeed\.max_torque = 0: must be a finite number > 0"),
        ({"family": "ideal", "motor": {}}, "unknown actuator field motor"),
    ],
)
def test_a_mapping_that_its_family_cannot_read_is_refused(mapping, message):
    with pytest.raises(ValueError, match=message):
        actuator_from_mapping(mapping)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("nowhere_at_all:Mine", "'nowhere_at_all:Mine': No module named 'nowhere_at_all'; must be module:NAME"),
        (f"{__name__}:Yours", "has no attribute 'Yours'; must be module:NAME"),
        (f"{__name__}:Motor", "is no subclass of codrl_mj's ActuatorModel"),
        (f"{__name__}:MINE", "is no subclass of codrl_mj's ActuatorModel"),
    ],
)
def test_a_place_where_there_is_no_family_is_refused(place, message):
    with pytest.raises(ValueError, match=message):
        find_family(place)


# -- what an actuator is called -------------------------------------------------------------------------------


def drawer_motor(folder, **changes):
    """A motor's file of one's own: a copy of one of the catalogue, and what is changed in it."""
    from codrl_mj.own_code import asset_folder

    text = (asset_folder() / "motors" / "maxon-re65.toml").read_text()
    for old, new in changes.items():
        text = re.sub(rf"^{old} = .*$", f'{old} = "{new}"', text, flags=re.MULTILINE)
    (folder / "drawer.toml").write_text(text)
    return folder / "drawer.toml"


@pytest.mark.parametrize(
    ("given", "name"),
    [
        (None, "ideal"),
        ("weaker", "weaker"),
        ({"name": "weaker", "controller": {"kp": 9.0}}, "custom"),
        ("lag", "lag"),
        ("drive", "quanser-qube-servo-2"),  # whose numbers are the defaults
        ("kraken-x60", "kraken-x60"),
        ({"name": "kraken-x60", "motor": {"gear_ratio": 70.3, "arm_radius": 200}}, "kraken-x60"),
        ({"name": "kraken-x60", "supply": {"voltage": 10}, "controller": {"max_current": 3}}, "kraken-x60"),
        ({"name": "kraken-x60", "motor": {"resistance": 1.0}}, "kraken-x60, changed"),
        ({"name": "kraken-x60", "motor": {"resistance": 1.0}, "label": "rewound"}, "rewound"),
        ("drawer.toml", "drawer"),
        ({"name": "drawer.toml", "motor": {"gear_ratio": 5.0}}, "drawer"),
        ("swing.yaml", "swing"),
        ("bench/actuator.yaml", "bench"),
        ("short.yaml", "kraken-x60"),
        (f"{__name__}:MINE", f"{__name__}:MINE"),
        (f"{__name__}:Mine", f"{__name__}:Mine"),
    ],
)
def test_an_actuator_is_called_what_it_was_asked_for_by(tmp_path, monkeypatch, given, name):
    monkeypatch.chdir(tmp_path)
    drawer_motor(tmp_path)
    (tmp_path / "bench").mkdir()
    for file in ("swing.yaml", "bench/actuator.yaml"):
        (tmp_path / file).write_text(json.dumps(Lag(0.2).as_mapping()))
    (tmp_path / "short.yaml").write_text("name: kraken-x60\nmotor: {gear_ratio: 70.3}")
    made = resolve(given, CARTPOLE.paper[0], "cartpole")
    assert name_of(made, CARTPOLE.paper[0]) == name
    short = named_mapping(made)
    again = resolve(json.loads(json.dumps(short)), None, "nobody")
    assert again == made
    assert label_of(again) == label_of(made)


def test_a_motor_of_the_catalogue_is_known_by_its_numbers_and_written_short():
    there = resolve("kraken-x60", None, "nobody")
    geared = dataclasses.replace(there, motor=dataclasses.replace(there.motor, gear_ratio=70.3, arm_radius=200.0))
    assert label_of(geared) == ""
    assert name_of(geared) == "kraken-x60"
    assert named_mapping(labelled(geared, "kraken-x60")) == {
        "name": "kraken-x60",
        "motor": {"gear_ratio": 70.3, "arm_radius": 200.0},
    }
    other = dataclasses.replace(there, motor=dataclasses.replace(there.motor, resistance=1.0))
    assert name_of(other) == "drive"
    assert named_mapping(labelled(other, "kraken-x60")) == {"name": "kraken-x60", "motor": {"resistance": 1.0}}
    assert named_mapping(labelled(Lag(0.2), "slow")) == {"label": "slow", **Lag(0.2).as_mapping()}


def test_a_name_is_nothing_of_the_actuator(tmp_path):
    asked, plain = resolve(str(drawer_motor(tmp_path)), None, "nobody"), resolve("maxon-re65", None, "nobody")
    assert (name_of(asked), name_of(plain)) == ("drawer", "maxon-re65")
    assert asked == plain
    assert hash(asked) == hash(plain)
    assert asked.as_mapping() == plain.as_mapping()
    assert label_of(labelled(IDEAL, "nothing")) == ""


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "import nowhere_at_all",
            r"importing slipped failed: ModuleNotFoundError: .*'nowhere_at_all' \(.*slipped\.py, l",
        ),
        ("x = 1\ny = z", r"importing slipped failed: NameError: name 'z' is not defined \(.*slipped\.py, line 2\)"),
        ("def :", "importing slipped failed: SyntaxError"),
        ("MINES = 1", r"has no attribute 'Mine'; must be module:NAME; did you mean 'MINES'\? .*slipped\.py"),
    ],
)
def test_of_a_module_that_cannot_be_used_the_cause_is_said(source, message, tmp_path, monkeypatch):
    (tmp_path / "slipped.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slipped", raising=False)
    with pytest.raises(ValueError, match=message):
        find_family("slipped:Mine")
    sys.modules.pop("slipped", None)


# -- places and files ---------------------------------------------------------------------------------------


def test_an_actuator_or_a_family_of_anybodys_is_named_by_its_place():
    assert resolve(f"{__name__}:MINE", None, "nobody") == MINE
    assert label_of(MINE) == ""  # it may be known by other names
    assert resolve(f"{__name__}:Mine", None, "nobody") == Mine()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (f"{__name__}:CARTPOLE", "is neither an actuator nor a family of them"),
        (f"{__name__}:MIEN", "has no attribute 'MIEN'; must be module:NAME"),
        ("nowhere_at_all:MINE", "No module named 'nowhere_at_all'"),
        (":", "must be module:NAME"),
        (f"{__name__}:", "must be module:NAME"),
    ],
)
def test_a_place_where_there_is_no_actuator_is_refused(place, message):
    with pytest.raises(ValueError, match=message):
        resolve(place, None, "nobody")


@pytest.mark.parametrize("name", ["mine.yaml", "mine.yml", "mine.json"])
def test_a_file_holds_the_mapping(name, tmp_path):
    path = tmp_path / name
    for actuator in (Lag(0.2, 0.01), Actuator(Motor(resistance=3.0), supply=Supply(12.0, 0.5)), MINE):
        path.write_text(json.dumps(actuator.as_mapping()))  # JSON is YAML
        assert resolve(str(path), None, "nobody") == actuator
        assert resolve(path, None, "nobody") == actuator


def test_a_file_may_set_fields_over_a_named_actuator(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("name: weak\nmotor: {resistance: 2}\n")
    motor = dataclasses.replace(CARTPOLE.paper[0].motor, resistance=2.0)
    assert resolve_actuators(path, CARTPOLE) == (Actuator(motor, CurrentLoop(kp=1.0, ki=1.0)),)
    with pytest.raises(ValueError, match=re.escape(f"{path}: actuator = 'weak': a variation of the paper's")):
        resolve(path, None, "nobody")
    path.write_text(f"name: {path}\n")
    with pytest.raises(
        ValueError, match=re.escape(f"{path}: name = '{path}': must be an actuator's name, and no file")
    ):
        resolve_actuators(path, CARTPOLE)


def test_yaml_may_be_written_by_hand(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("motor: {resistance: 2}\ncontroller:\n  kp: 1.5  # V/A\n  max_voltage: .inf\n")
    assert resolve(path, None, "nobody") == Actuator(
        Motor(resistance=2.0), CurrentLoop(kp=1.5, max_voltage=float("inf"))
    )


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "3",
        "",
        "[1, 2]",
        "family: lagg",
        "motr: {}",
        "motor: 3",
        "controller: {kp: -1}",
        "1: 2",
        "controller: {kp: }",
    ],
)
def test_a_file_that_describes_no_actuator_is_refused_with_its_name(text, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(f"{path}: ")):
        resolve(str(path), None, "nobody")


def test_a_file_that_is_not_there_is_refused_with_its_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=re.escape(f"no actuator file at {tmp_path / 'none.yaml'}")):
        resolve(str(tmp_path / "none.yaml"), None, "nobody")


# -- single fields over another actuator ----------------------------------------------------------------------


def test_single_fields_are_set_over_anothers():
    base = Actuator(Motor(resistance=2.0), CurrentLoop(kp=3.0, ki=4.0))
    changed = actuator_over(base, {"controller": {"kp": 5.0}, "motor": {"inductance": 0.3}})
    assert changed == Actuator(Motor(resistance=2.0, inductance=0.3), CurrentLoop(kp=5.0, ki=4.0))
    assert actuator_over(base, {"supply": {"voltage": 12.0}}).supply == Supply(voltage=12.0)
    assert actuator_over(Actuator(supply=Supply(12.0)), {"supply": None}) == Actuator()
    assert actuator_over(changed, {}) is changed
    assert actuator_over(Lag(0.1, 0.2), {"delay": 0.3}) == Lag(0.1, 0.3)
    assert actuator_over(TorqueSpeed(), {"max_torque": 2.0}) == TorqueSpeed(max_torque=2.0)
    assert actuator_over(IDEAL, {"motor": {}}) is IDEAL


def test_what_cannot_be_set_is_refused():
    with pytest.raises(ValueError, match="the ideal actuator has no motor and no controller to set fields of"):
        actuator_over(IDEAL, {"motor": {"resistance": 1.0}})
    with pytest.raises(ValueError, match=r"unknown actuator field motor\.resistence"):
        actuator_over(Actuator(), {"motor": {"resistence": 1.0}})
    with pytest.raises(ValueError, match=r"Lag\.delay = -1"):
        actuator_over(Lag(), {"delay": -1})
