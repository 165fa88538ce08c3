"""Actuators and families by name, and all other ways to specify an actuator."""

import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path

import pytest
from hypothesis import given

from codrl_mj.actuators import (
    FAMILIES,
    IDEAL,
    NAMED,
    ActuatorModel,
    CurrentLoop,
    DCMotorActuator,
    Lag,
    Motor,
    Supply,
    TorqueSpeed,
    actuator_from_mapping,
    check_same_family,
    display_label,
    display_name,
    find_family,
    mapping_of,
    named_mapping,
    override_actuator,
    resolve,
    set_display_name,
)
from codrl_mj.fields import real
from codrl_mj.tasks import TASKS, named_actuator, resolve_actuators
from codrl_mj.user_code import asset_folder
from tests.actuators.strategies import of_every_family
from tests.tasks.faces import every_rebuilt

CARTPOLE = TASKS["cartpole"]


@dataclasses.dataclass(frozen=True)
class Mine(ActuatorModel):
    """Custom family."""

    family = "mine"
    strength: float = real(2.0, above=0.0)

    @staticmethod
    def advance(parameters, timestep, state, inputs):  # noqa: ARG004
        return state, parameters.strength * inputs.desired_torque, state


MINE = Mine(3.0)

# arXiv 2507.00268, Experimental Results: kP, kI, kD, kFF, arm.
PAPER_GAINS = {
    "pendulum": (1.0, 20.0, 1e-6, 0.0, 1.0),
    "mountain_car": (1.0, 1.0, 1e-2, 0.0, 1.0),
    "mountain_car_continuous": (0.1, 10.0, 1e-3, 0.0, 1.0),
    "acrobot": (1.0, 10.0, 1e-6, 0.0, 1.0),
    "cartpole": (4.3, 1.0, 1e-6, 0.6, 0.15),
}


@every_rebuilt
def test_named_actuators_are_the_papers_actuator_and_its_variations(task):
    kp, ki, kd, kff, arm = PAPER_GAINS[task]
    motor = Motor(
        resistance=1.0, inductance=0.1, torque_constant=1.0, back_emf_constant=1.0, arm_radius=arm
    )
    expected = {
        "paper": DCMotorActuator(motor, CurrentLoop(kp, ki, kd, kff, max_voltage=24.0)),
        "weak": DCMotorActuator(motor, CurrentLoop(kp=1.0, ki=1.0)),
        "weaker": DCMotorActuator(motor, CurrentLoop(kp=0.2, ki=0.2)),
        # At this voltage, u = R*i_ref, the current i_ref is at rest.
        "open_loop": DCMotorActuator(
            dataclasses.replace(motor, inductance=0.5), CurrentLoop(kp=0.0, kff=motor.resistance)
        ),
    }
    assert {name: named_actuator(name, task) for name in NAMED} == {"ideal": IDEAL, **expected}
    assert len(TASKS[task].paper) == len(TASKS[task].motors)
    for name in NAMED:
        named_actuator(name, task).check(TASKS[task].step_duration / TASKS[task].motor_inner_steps)


# -- several motors --------------------------------------------------------------------------------

# -- all ways to specify an actuator ---------------------------------------------------------------

FED = DCMotorActuator(Motor(resistance=3.0), supply=Supply(12.0, 0.5))
BY_HAND = "motor: {resistance: 2}\ncontroller:\n  kp: 1.5  # V/A\n  max_voltage: .inf\n"
FILES = {  # JSON is YAML
    **{
        f"lag{kind}": json.dumps(Lag(0.2, 0.01).as_mapping()) for kind in (".yaml", ".yml", ".json")
    },
    "fed.json": json.dumps(FED.as_mapping()),
    "mine.json": json.dumps(MINE.as_mapping()),
    "by_hand.yaml": BY_HAND,
    "over.yaml": "name: weak\nmotor: {resistance: 2}\n",
    "itself.yaml": "name: itself.yaml\n",
    "short.yaml": "name: kraken-x60\nmotor: {gear_ratio: 70.3}",
    "swing.yaml": json.dumps(Lag(0.2).as_mapping()),
    "bench/actuator.yaml": json.dumps(Lag(0.2).as_mapping()),
    "slipped/missing.py": "import nowhere_at_all",
    "slipped/undefined.py": "x = 1\ny = z",
    "slipped/unreadable.py": "def :",
    "slipped/other.py": "MINES = 1",
}
WRONG_FILES = (
    "{",
    "3",
    "",
    "[1, 2]",
    "family: lagg",
    "motr: {}",
    "motor: 3",
    "controller: {kp: -1}",
    "1: 2",
)
WRONG_FILES = {
    f"wrong{index}.yaml": text for index, text in enumerate((*WRONG_FILES, "controller: {kp: }"))
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Create the files above, and a motor file copied from the catalogue."""
    for name, text in (FILES | WRONG_FILES).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    shutil.copy(asset_folder() / "motors" / "maxon-re65.toml", tmp_path / "drawer.toml")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield
    for name in {module for module in sys.modules if module.startswith("slipped")} - before:
        del sys.modules[name]


def over(part, **fields):
    """Return the cart-pole's weak actuator with some fields changed."""
    weak = DCMotorActuator(CARTPOLE.paper[0].motor, CurrentLoop(kp=1.0, ki=1.0))
    return dataclasses.replace(weak, **{part: dataclasses.replace(getattr(weak, part), **fields)})


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (FED, FED),
        (FED.as_mapping(), FED),
        ("paper", CARTPOLE.paper[0]),
        ("ideal", IDEAL),
        (None, IDEAL),
        *((name, family()) for name, family in FAMILIES.items()),
        ({"motor": {"resistance": 3}}, DCMotorActuator(Motor(resistance=3.0))),
        ({"family": "current_loop"}, DCMotorActuator()),
        ({"family": f"{__name__}:Mine", "strength": 3.0}, MINE),
        (MINE.as_mapping(), MINE),
        (f"{__name__}:MINE", MINE),
        (f"{__name__}:Mine", Mine()),
        (Path("lag.yaml"), Lag(0.2, 0.01)),
        *((f"lag{kind}", Lag(0.2, 0.01)) for kind in (".yaml", ".yml", ".json")),
        ("fed.json", FED),
        ("mine.json", MINE),
        (
            "by_hand.yaml",
            DCMotorActuator(Motor(resistance=2.0), CurrentLoop(kp=1.5, max_voltage=math.inf)),
        ),
        ("over.yaml", over("motor", resistance=2.0)),
        ({"name": "weak", "controller": {"kp": 5.0}}, over("controller", kp=5.0)),
    ],
)
def test_every_way_to_specify_an_actuator_works(files, setting, expected):
    assert (
        resolve_actuators(setting, CARTPOLE)
        == resolve_actuators([setting], CARTPOLE)
        == (expected,)
    )
    assert setting is not FED or resolve_actuators(setting, CARTPOLE)[0] is FED


BARE = dataclasses.replace(CARTPOLE, paper=(), name="bare")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "papr",
            r"^unknown actuator 'papr': did you mean 'paper'\? It can also be your own as module:NAME$",
        ),
        ("weakest", r"'weakest': did you mean 'weaker'\?"),
        ("open-loop", r"'open-loop': did you mean 'open_loop'\?"),
        (
            "maxon-ec45",
            r"'maxon-ec45': did you mean 'maxon-ec45-flat-339285' or 'maxon-ec45-flat-50w'\?",
        ),
        ("Maxon-EC45-flat-50", r"did you mean 'maxon-ec45-flat-50w'\?"),
        (
            "12345",
            (
                r"'12345': Known: ideal, paper, weak, weaker(?!.*maxon).*, the motors of `codrl-mj"
                r" motor list`"
            ),
        ),
        *(
            (value, r"actuator = .*must be a name \(ideal.*\), an actuator or a mapping")
            for value in (3, 1.5, Motor())
        ),
        ({"motr": {}}, r"unknown actuator field motr; did you mean motor\?$"),
        ({"controllr": {}}, r"unknown actuator field controllr; did you mean controller\?$"),
        (
            {"motor": {"inductanse": 0.1}},
            r"field motor\.inductanse; did you mean motor\.inductance\?$",
        ),
        (
            {"motor": {"arm_radus": 0.1}, "controller": {}},
            r"motor\.arm_radus; did you mean motor\.arm_radius\?$",
        ),
        ({"controller": {"kf": 5.0}}, r"controller\.kf; did you mean controller\.kff\?$"),
        (
            {"supply": {"resistence": 5.0}},
            r"supply\.resistence; did you mean supply\.resistance\?$",
        ),
        (
            {"motor": {"zzz": 1.0}},
            r"unknown actuator field motor\.zzz; known: resistance, inductance,",
        ),
        ({"motor": 3.0}, r"'motor' = 3\.0: must be a mapping of Motor's fields"),
        ({"controller": {"ki": -2.0}}, r"CurrentLoop\.ki = -2\.0: must be a finite number >= 0"),
        ({"family": "lagg"}, r"unknown family 'lagg': did you mean 'lag'"),
        ({"family": "torque-speed"}, r"unknown family 'torque-speed': did you mean 'torque_speed'"),
        (
            {"family": "lag", "time_constnt": 1.0},
            r"unknown actuator field time_constnt; did you mean time_constant\?",
        ),
        (
            {"family": "lag", "motor": {}},
            "unknown actuator field motor; known: time_constant, delay",
        ),
        ({"family": "lag", "delay": -1.0}, r"Lag\.delay = -1\.0: must be a finite number >= 0"),
        (
            {"family": "torque_speed", "max_torque": 0},
            r"TorqueSpeed\.max_torque = 0: must be a number > 0",
        ),
        ({"family": "ideal", "motor": {}}, "unknown actuator field motor"),
        (
            {"family": "nowhere_at_all:Mine"},
            "'nowhere_at_all:Mine': No module named 'nowhere_at_all'; must be",
        ),
        ({"family": f"{__name__}:Yours"}, "has no attribute 'Yours'; must be module:NAME"),
        ({"family": f"{__name__}:Motor"}, "is not a subclass of codrl_mj's ActuatorModel"),
        ({"family": f"{__name__}:MINE"}, "is not a subclass of codrl_mj's ActuatorModel"),
        (
            {"family": "slipped.missing:Mine"},
            r"missing failed: ModuleNotFoundError: .*'nowhere_at_all' \(.*missing\.py",
        ),
        (
            {"family": "slipped.undefined:Mine"},
            r"NameError: name 'z' is not defined \(.*undefined\.py, line 2\)",
        ),
        ({"family": "slipped.unreadable:Mine"}, "importing slipped.unreadable failed: SyntaxError"),
        (
            {"family": "slipped.other:Mine"},
            r"'Mine'; must be module:NAME; did you mean 'MINES'\? .*other\.py",
        ),
        (f"{__name__}:CARTPOLE", "must be an actuator or a family of actuators"),
        (f"{__name__}:MIEN", "has no attribute 'MIEN'; must be module:NAME"),
        ("nowhere_at_all:MINE", "No module named 'nowhere_at_all'"),
        (":", "must be module:NAME"),
        (f"{__name__}:", "must be module:NAME"),
        (
            "itself.yaml",
            r"^itself\.yaml: name = 'itself\.yaml': must be an actuator's name, or a file that",
        ),
        *((name, rf"^{name}: ") for name in WRONG_FILES),
        (
            {"name": "ideal", "motor": {"resistance": 1.0}},
            "the ideal actuator has no motor and no controller, and so",
        ),
        (
            {"name": "paper", "motor": {"resistence": 1.0}},
            r"unknown actuator field motor\.resistence",
        ),
        ({"name": "lag", "delay": -1}, r"Lag\.delay = -1"),
    ],
)
def test_raises_with_the_reason_if_a_setting_is_no_actuator(files, setting, message):
    with pytest.raises(ValueError, match=message):
        resolve_actuators(setting, CARTPOLE)


@pytest.mark.parametrize("name", ["paper", "weak", "open_loop", "over.yaml"])
def test_raises_if_a_task_has_no_paper_actuator_to_vary(files, name):
    with pytest.raises(
        ValueError,
        match=r"actuator = '\w+': .* but bare has no such actuator; known names: current_loop",
    ):
        resolve_actuators(name, BARE)
    assert resolve_actuators("ideal", BARE) == (IDEAL,)
    assert resolve_actuators("lag", BARE) == (Lag(),)


def test_raises_with_the_name_of_a_missing_file():
    with pytest.raises(FileNotFoundError, match=r"no actuator file at none\.yaml"):
        resolve("none.yaml", None, "the task")


PAIR = dataclasses.replace(
    CARTPOLE,
    name="pair",
    motors=("left", "right"),
    forces=((-10.0, -10.0), (10.0, 10.0)),
    paper=(DCMotorActuator(Motor(inductance=0.2)), DCMotorActuator(Motor(inductance=0.3))),
)


def test_every_motor_has_a_variation_of_its_own_paper_actuator():
    for name, gain in (("weak", 1.0), ("weaker", 0.2)):
        loop = CurrentLoop(kp=gain, ki=gain)
        assert resolve_actuators(name, PAIR) == tuple(
            DCMotorActuator(paper.motor, loop) for paper in PAIR.paper
        )
    assert resolve_actuators(["paper", "weak"], PAIR)[0] == PAIR.paper[0]
    assert resolve_actuators(Lag(), PAIR) == (Lag(), Lag())
    assert check_same_family([Lag(0.1), Lag(0.2)]) is Lag


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (["paper"], r"1 actuators, but pair has 2 motors \(left, right\)"),
        (["paper"] * 3, r"3 actuators, but pair has 2 motors \(left, right\)"),
        (["paper", Lag()], r"actuators of several families \(DCMotorActuator, Lag\)"),
    ],
)
def test_raises_if_actuators_do_not_match_the_motors(setting, message):
    with pytest.raises(ValueError, match=message):
        resolve_actuators(setting, PAIR)


# -- families --------------------------------------------------------------------------------------


@given(of_every_family)
def test_mappings_round_trip_through_json(actuator):
    mapping = actuator.as_mapping()
    assert actuator_from_mapping(mapping) == actuator
    assert actuator_from_mapping(json.loads(json.dumps(mapping))) == actuator
    saved = mapping_of(actuator)
    assert (saved is None) == (actuator == IDEAL)
    assert resolve(json.loads(json.dumps(saved)), None, "the task") == actuator


def test_a_family_is_found_by_name_and_import_path():
    for name, family in FAMILIES.items():
        assert find_family(name) is find_family(f"{family.__module__}:{family.__name__}") is family
        assert name == family.family


# -- display names -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        (None, "ideal"),
        ("weaker", "weaker"),
        ({"name": "weaker", "controller": {"kp": 9.0}}, "custom"),
        ("lag", "lag"),
        ("drive", "quanser-qube-servo-2"),  # the defaults are the fields of this motor
        ("kraken-x60", "kraken-x60"),
        ({"name": "kraken-x60", "motor": {"gear_ratio": 70.3, "arm_radius": 200}}, "kraken-x60"),
        (
            {"name": "kraken-x60", "supply": {"voltage": 10}, "controller": {"max_current": 3}},
            "kraken-x60",
        ),
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
def test_an_actuator_is_displayed_by_its_setting(files, setting, name):
    actuator = resolve(setting, CARTPOLE.paper[0], "cartpole")
    assert display_name(actuator, CARTPOLE.paper[0]) == name
    copy = resolve(json.loads(json.dumps(named_mapping(actuator))), None, "the task")
    assert copy == actuator
    assert display_label(copy) == display_label(actuator)


def test_a_catalogue_motor_is_recognized_by_its_fields_and_written_briefly():
    base = resolve("kraken-x60", None, "the task")
    geared = dataclasses.replace(
        base, motor=dataclasses.replace(base.motor, gear_ratio=70.3, arm_radius=200.0)
    )
    assert display_label(geared) == ""
    assert display_name(geared) == "kraken-x60"
    assert named_mapping(set_display_name(geared, "kraken-x60")) == {
        "name": "kraken-x60",
        "motor": {"gear_ratio": 70.3, "arm_radius": 200.0},
    }
    changed = dataclasses.replace(base, motor=dataclasses.replace(base.motor, resistance=1.0))
    assert display_name(changed) == "drive"
    assert named_mapping(set_display_name(changed, "kraken-x60")) == {
        "name": "kraken-x60",
        "motor": {"resistance": 1.0},
    }
    assert named_mapping(set_display_name(Lag(0.2), "slow")) == {
        "label": "slow",
        **Lag(0.2).as_mapping(),
    }


def test_a_display_name_does_not_affect_equality_hash_or_mapping(files):
    labelled, plain = (
        resolve("drawer.toml", None, "the task"),
        resolve("maxon-re65", None, "the task"),
    )
    assert (display_name(labelled), display_name(plain)) == ("drawer", "maxon-re65")
    assert (labelled, hash(labelled), labelled.as_mapping()) == (
        plain,
        hash(plain),
        plain.as_mapping(),
    )
    # The same motor may have several display names.
    assert display_label(set_display_name(IDEAL, "nothing")) == display_label(MINE) == ""


# -- import paths and files ------------------------------------------------------------------------


# -- changes of single fields --------------------------------------------------------------------


def test_single_fields_of_an_actuator_are_changed():
    base = DCMotorActuator(Motor(resistance=2.0), CurrentLoop(kp=3.0, ki=4.0))
    changed = override_actuator(base, {"controller": {"kp": 5.0}, "motor": {"inductance": 0.3}})
    assert changed == DCMotorActuator(
        Motor(resistance=2.0, inductance=0.3), CurrentLoop(kp=5.0, ki=4.0)
    )
    assert override_actuator(base, {"supply": {"voltage": 12.0}}).supply == Supply(voltage=12.0)
    assert (
        override_actuator(DCMotorActuator(supply=Supply(12.0)), {"supply": None})
        == DCMotorActuator()
    )
    assert override_actuator(changed, {}) is changed
    assert override_actuator(Lag(0.1, 0.2), {"delay": 0.3}) == Lag(0.1, 0.3)
    assert override_actuator(TorqueSpeed(), {"max_torque": 2.0}) == TorqueSpeed(max_torque=2.0)
    assert override_actuator(IDEAL, {"motor": {}}) is IDEAL


def test_missing_fields_of_an_optional_part_take_its_defaults():
    """Check that a supply has 24 V by default, also if only its resistance is specified."""
    for drive in ({"family": "drive"}, {"name": "maxon-ec45-flat-339285"}):
        drive_actuator = resolve({**drive, "supply": {"resistance": 0.5}}, None, "x")
        assert drive_actuator.supply == Supply(24.0, 0.5)
    assert resolve({"supply": {"resistance": 0.5}}, None, "x").supply == Supply(resistance=0.5)


@pytest.mark.parametrize(
    ("setting", "assumption"),
    [
        (
            {"family": "drive", "motor": {"torque_constant": 0.007}},
            "motor.back_emf_constant = 0.042, a default",
        ),
        (
            {"family": "drive", "motor": {"back_emf_constant": 0.5}},
            "motor.torque_constant = 0.042, a default",
        ),
        (
            {"supply": {"voltage": 48.0}},
            "controller.max_voltage = 24 V, which limits the supply of 48 V",
        ),
    ],
)
def test_a_default_that_limits_a_specified_value_is_reported(setting, assumption):
    assert assumption in resolve(setting, None, "x").assumed
    assert (
        assumption
        not in resolve({"family": setting.get("family", "current_loop")}, None, "x").assumed
    )
