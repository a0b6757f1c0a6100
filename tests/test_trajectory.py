import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory


def wave(n: int = 50, **changes: object) -> Trajectory:
    t = np.linspace(0.0, 1.0, n)
    settings: dict = {"t": t, "states": np.sin(7 * t)[:, None], "state_names": ["x"], **changes}
    return Trajectory(**settings)


def test_values_put_states_before_inputs() -> None:
    run = wave(inputs=np.full((50, 1), 3.0), input_names=["V_d"], units={"V_d": "V"})
    assert run.names == ("x", "V_d")
    assert np.array_equal(run.values[:, 1], np.full(50, 3.0))
    assert dict(run.units) == {"x": "1", "V_d": "V"}


def test_arrays_are_copied_and_locked() -> None:
    t = np.linspace(0.0, 1.0, 50)
    states = np.sin(7 * t)[:, None]
    run = Trajectory(t=t, states=states, state_names=["x"])
    states[:] = 0.0
    assert run.states.max() > 0.9
    with pytest.raises(ValueError, match="read-only"):
        run.states[0] = 1.0


def test_window_keeps_inputs_and_units() -> None:
    run = wave(inputs=np.arange(50.0)[:, None], input_names=["u"], units={"x": "m"})
    part = run.window(10, 20)
    assert np.array_equal(part.columns(["u"])[:, 0], np.arange(10.0, 20.0))
    assert part.units["x"] == "m"


NAN_STATES = np.sin(np.arange(50.0))[:, None]
NAN_STATES[12] = np.nan
REPEATED = np.linspace(0.0, 1.0, 50)
REPEATED[20] = REPEATED[19]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": NAN_STATES}, r"x\[12\] = nan at t = 0.244898 s"),
        ({"t": REPEATED}, r"t must increase: t\[20\] = 0.387755102 s follows 0.387755102 s"),
        ({"states": np.full((50, 1), 2.5)}, "'x' stays at 2.5 over all 50 samples; leave it out"),
    ],
)
def test_bad_samples_are_refused_by_name(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wave(**changes)
