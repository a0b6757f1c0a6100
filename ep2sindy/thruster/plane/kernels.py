"""Time integration: steps within the CFL number, and the samples that they fill."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.state_kernels import ENTRY, LOOP, NO_NAN, ONE
from ep2sindy.thruster.plane.electron_kernels import electron_step
from ep2sindy.thruster.plane.heavy_kernels import column, heavy_step, velocities


@compiled(**NO_NAN)
def fastest(u_z, u_r, start, stop, per_dz, per_dr):
    """Largest |u_z|/dz + |u_r|/dr in a column."""
    top = 0.0
    for j in range(start, stop):
        top = max(top, abs(u_z[j]) * per_dz + abs(u_r[j]) * per_dr)
    return top


@compiled(**ENTRY)
def fastest_rate(state, model):
    """Largest (|u_z| + c)/dz + (|u_r| + c)/dr of any cell, in 1/s; c: speed of sound."""
    gas, per_dz, per_dr = state.gas, 1.0 / model.dz, 1.0 / model.dr
    top = 4.0 * model.neutral_diffusion * per_dr**2
    for i in range(gas.n.shape[0]):
        c = np.sqrt(model.electron_sound_squared * state.T_e_eV[i] + model.ion_sound_squared)
        flow = fastest(gas.u_z[i], gas.u_r[i], model.lower[i], model.upper[i], per_dz, per_dr)
        top = max(top, flow + c * (per_dz + per_dr))
    return top


@compiled(**ENTRY)
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


@compiled(**ENTRY)
def count_heavy(state, model):
    """Atoms and ions in the domain."""
    total = 0.0
    for i in range(state.gas.n.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            total += (state.gas.n[i, j] + state.gas.neutrals[i, j]) * model.area[j]
    return model.dz * total


@compiled(**LOOP)
def add_column(sum_n, sum_nn, sum_z, sum_r, here, start, stop, fraction):
    for j in range(start, stop):
        sum_n[j] += fraction * here.n[j]
        sum_nn[j] += fraction * here.neutrals[j]
        sum_z[j] += fraction * here.u_z[j]
        sum_r[j] += fraction * here.u_r[j]


@compiled(**ENTRY)
def add(state, model, fraction, planes, profiles, numbers):
    """Add a fraction of the state to the sample: fields, profiles along z, current and thrust."""
    n, nn, u_z, u_r = planes[0], planes[1], planes[2], planes[3]
    for i in range(state.T_e_eV.size):
        start, stop = model.lower[i], model.upper[i]
        add_column(n[i], nn[i], u_z[i], u_r[i], column(state.gas, i), start, stop, fraction)
        profiles[0, i] += fraction * state.T_e_eV[i]
        profiles[1, i] += fraction * state.ionization[i]
        profiles[2, i] += fraction * state.reference_field[i]
    numbers[0] += fraction * state.current[0]
    numbers[1] += fraction * thrust(state, model)


@compiled(**ENTRY)
def store(sample, rows, row, model):
    """Write the plasma's cells of a sample into a row of the output."""
    for i in range(sample.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            rows[row, i, j] = sample[i, j]


@compiled(**ENTRY)
def advance(state, model, work, sample_s, averaged, n_i, n_n, u_iz, u_ir, profiles, series):
    """Fill the rows of the outputs, one every `sample_s`; return (rows filled, steps).

    averaged: if True, rows are means over the steps of a sample, else the state at its end.
    n_i .. u_ir: (rows, n_z, n_r), written in the plasma only. profiles: (rows, 3, n_z) for T_e,
    ionization and field. series: (rows, 4) for current, thrust, mass out and mass held.
    """
    planes, profile, numbers = work.planes, work.profiles, work.numbers
    velocities(state.gas, model)
    steps = 0
    if not electron_step(state, model, 0.0, work.columns):
        return 0, steps
    for row in range(series.shape[0]):
        planes[:], profile[:], numbers[:] = 0.0, 0.0, 0.0
        left = sample_s
        while left > 1e-9 * sample_s:
            dt = left / np.ceil(left * fastest_rate(state, model) / model.cfl)
            heavy_step(state, model, dt, work)
            if not electron_step(state, model, dt, work.columns):
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
        for k in range(profile.shape[0]):
            for i in range(profile.shape[1]):
                profiles[row, k, i] = profile[k, i]
        series[row, 0], series[row, 1] = numbers
        series[row, 2] = model.ion_mass * state.left[0]
        series[row, 3] = model.ion_mass * count_heavy(state, model)
    return series.shape[0], steps
