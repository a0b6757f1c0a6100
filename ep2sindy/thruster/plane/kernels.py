"""Time integration: steps within the CFL number, and the samples that they fill."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.plane.electron_kernels import electron_step
from ep2sindy.thruster.plane.heavy_kernels import heavy_step, velocities
from ep2sindy.thruster.plane.state_kernels import FAST, ONE, Columns, Fluxes, Gas, Work


@compiled
def fluxes(n_z, n_r):
    """Empty flux arrays of one direction."""
    shape = (n_z, n_r)
    return Fluxes(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))


@compiled
def scratch(n_z, n_r):
    """Working memory of the heavy step and the electron step."""
    grid = (n_z, n_r)
    slopes = Gas(
        np.zeros(grid), np.zeros(grid), np.zeros(grid), np.zeros(grid), np.zeros(grid),
        np.zeros(grid),
    )  # fmt: skip
    axial, radial = fluxes(n_z + 1, n_r), fluxes(n_z, n_r + 1)
    work = Work(slopes, axial, radial, fluxes(n_z, n_r), np.zeros(n_r))
    columns = Columns(
        np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z),
        np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z), np.zeros(n_z),
        np.zeros(n_z),
    )  # fmt: skip
    return work, columns


@compiled(**FAST)
def fastest_rate(state, model, top):
    """Largest (|u_z| + c)/dz + (|u_r| + c)/dr of any cell, in 1/s; c: speed of sound."""
    gas, per_dz, per_dr = state.gas, 1.0 / model.dz, 1.0 / model.dr
    top[:] = 0.0
    for i in range(gas.n.shape[0]):
        c = np.sqrt(model.electron_sound_squared * state.T_e_eV[i] + model.ion_sound_squared)
        sound = c * (per_dz + per_dr)
        for j in range(model.lower[i], model.upper[i]):
            rate = abs(gas.u_z[i, j]) * per_dz + abs(gas.u_r[i, j]) * per_dr + sound
            top[j] = max(top[j], rate)
    return max(top.max(), 4.0 * model.neutral_diffusion * per_dr**2)


@compiled(**FAST)
def thrust(state, model):
    """Axial ion momentum that leaves through the cathode plane and the plume's sides, in N."""
    gas, last = state.gas, state.gas.n.shape[0] - 1
    total = 0.0
    for j in range(model.lower[last], model.upper[last]):
        total += model.area[j] * gas.flux_z[last, j] * gas.u_z[last, j]
    for i in range(model.exit_column, last + 1):
        j, face = model.lower[i], model.upper[i]
        k = face - ONE
        inward = model.perimeter[j] * gas.flux_z[i, j] * max(-gas.u_r[i, j], 0.0)
        outward = model.perimeter[face] * gas.flux_z[i, k] * max(gas.u_r[i, k], 0.0)
        total += model.dz * (inward + outward)
    return model.ion_mass * total


@compiled(**FAST)
def count_heavy(state, model):
    """Atoms and ions in the domain."""
    total = 0.0
    for i in range(state.gas.n.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            total += (state.gas.n[i, j] + state.gas.neutrals[i, j]) * model.area[j]
    return model.dz * total


@compiled(**FAST)
def add_grid(values, total, model, share):
    """Add share * values to total, in the cells with plasma."""
    for i in range(values.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            total[i, j] += share * values[i, j]


@compiled(**FAST)
def add(state, model, share, planes, profiles, numbers):
    """Add a share of the state to the sample: fields, profiles along z, current and thrust."""
    add_grid(state.gas.n, planes[0], model, share)
    add_grid(state.gas.neutrals, planes[1], model, share)
    add_grid(state.gas.u_z, planes[2], model, share)
    add_grid(state.gas.u_r, planes[3], model, share)
    for i in range(state.T_e_eV.size):
        profiles[0, i] += share * state.T_e_eV[i]
        profiles[1, i] += share * state.ionization[i]
        profiles[2, i] += share * state.reference_field[i]
    numbers[0] += share * state.current[0]
    numbers[1] += share * thrust(state, model)


@compiled(**FAST)
def store(sample, rows, row, model):
    """Write the plasma's cells of a sample into a row of the output."""
    for i in range(sample.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            rows[row, i, j] = sample[i, j]


@compiled(**FAST)
def advance(state, model, sample_s, averaged, n_i, n_n, u_iz, u_ir, profiles, series):
    """Fill the rows of the outputs, one every `sample_s`; return (rows filled, steps).

    averaged: if True, rows are means over the steps of a sample, else the state at its end.
    n_i .. u_ir: (rows, n_z, n_r), written in the plasma only. profiles: (rows, 3, n_z) for T_e,
    ionization and field. series: (rows, 4) for current, thrust, mass out and mass held.
    """
    n_z, n_r = state.gas.n.shape
    work, columns = scratch(n_z, n_r)
    planes, profile, numbers = np.zeros((4, n_z, n_r)), np.zeros((3, n_z)), np.zeros(2)
    velocities(state.gas, model)
    steps = 0
    if not electron_step(state, model, 0.0, columns):
        return 0, steps
    for row in range(series.shape[0]):
        planes[:], profile[:], numbers[:] = 0.0, 0.0, 0.0
        left = sample_s
        while left > 1e-9 * sample_s:
            dt = left / np.ceil(left * fastest_rate(state, model, work.born) / model.cfl)
            heavy_step(state, model, dt, work)
            if not electron_step(state, model, dt, columns):
                return row, steps
            left -= dt
            steps += 1
            if averaged:
                add(state, model, dt / sample_s, planes, profile, numbers)
        if not averaged:
            add(state, model, 1.0, planes, profile, numbers)
        store(planes[0], n_i, row, model)
        store(planes[1], n_n, row, model)
        store(planes[2], u_iz, row, model)
        store(planes[3], u_ir, row, model)
        profiles[row] = profile
        series[row, 0], series[row, 1] = numbers
        series[row, 2] = model.ion_mass * state.left[0]
        series[row, 3] = model.ion_mass * count_heavy(state, model)
    return series.shape[0], steps
