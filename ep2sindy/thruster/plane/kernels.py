"""Time integration: steps within the CFL number, and the samples that they fill."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.state_kernels import ENTRY, LOOP, NO_NAN, ONE
from ep2sindy.thruster.plane.electron_kernels import electron_step
from ep2sindy.thruster.plane.heavy_kernels import heavy_step, velocities


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
def add_column(total, values, start, stop, fraction):
    for j in range(start, stop):
        total[j] += fraction * values[j]


@compiled(**ENTRY)
def add(state, model, fraction, planes, profiles, numbers):
    """Add a fraction of the state to the sample: fields, profiles along z, current and thrust."""
    gas = state.gas
    for k, field in enumerate((gas.n, gas.neutrals, gas.u_z, gas.u_r)):
        for i in range(field.shape[0]):
            add_column(planes[k, i], field[i], model.lower[i], model.upper[i], fraction)
    for k, along_z in enumerate((state.T_e_eV, state.ionization, state.reference_field)):
        add_column(profiles[k], along_z, 0, along_z.size, fraction)
    numbers[0] += fraction * state.current[0]
    numbers[1] += fraction * thrust(state, model)


@compiled(**ENTRY)
def advance(state, model, work, sample_s, averaged, fields, profiles, series):
    """Fill the rows of the outputs, one every `sample_s`; return the number of rows filled.

    averaged: if True, rows are means over the steps of a sample, else the state at its end.
    fields: n_i, n_n, u_iz and u_ir, each (rows, n_z, n_r), written in the plasma only. profiles:
    (rows, 3, n_z) for T_e, ionization and field. series: (rows, 4) for current, thrust, mass out
    and mass held.
    """
    planes, profile, numbers = work.planes, work.profiles, work.numbers
    velocities(state.gas, model)
    if not electron_step(state, model, 0.0, work.columns):
        return 0
    for row in range(series.shape[0]):
        planes[:], profile[:], numbers[:] = 0.0, 0.0, 0.0
        left = sample_s
        while left > 1e-9 * sample_s:
            dt = left / np.ceil(left * fastest_rate(state, model) / model.cfl)
            heavy_step(state, model, dt, work)
            if not electron_step(state, model, dt, work.columns):
                return row
            left -= dt
            if averaged:
                add(state, model, dt / sample_s, planes, profile, numbers)
        if not averaged:
            add(state, model, 1.0, planes, profile, numbers)
        for k in range(planes.shape[0]):
            for i in range(planes.shape[1]):
                for j in range(model.lower[i], model.upper[i]):
                    fields[k][row, i, j] = planes[k, i, j]
        for k in range(profile.shape[0]):
            for i in range(profile.shape[1]):
                profiles[row, k, i] = profile[k, i]
        series[row, 0], series[row, 1] = numbers
        series[row, 2] = model.ion_mass * state.left[0]
        series[row, 3] = model.ion_mass * count_heavy(state, model)
    return series.shape[0]
