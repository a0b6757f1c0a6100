"""Ions and neutrals: one SSP-RK2 step in a frozen field, column by column.

Inner loops run along r, write one array each and make no calls, so that they vectorise.
"""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.constants import E_CHARGE
from ep2sindy.thruster.plane.state_kernels import FAST, ONE

SIDE_SPEED = 0.5  # of the neutrals' speed: diffusive loss into vacuum (Marshak)


@compiled(inline="always")
def half_slope(left, centre, right):
    """Half the van Leer slope: a*b/(a+b) of the two differences, 0 at an extremum."""
    a = centre - left
    b = right - centre
    return a * b / (a + b) if a * b > 0.0 else 0.0


@compiled(inline="always")
def mass_flux(n_l, u_l, n_r, u_r, c):
    """Rusanov flux of density between two states; c: speed of sound."""
    s = max(abs(u_l), abs(u_r)) + c
    return 0.5 * (n_l * u_l + n_r * u_r - s * (n_r - n_l))


@compiled(inline="always")
def momentum_flux(n_l, u_l, n_r, u_r, c):
    """Rusanov flux of the momentum across the face, pressure included."""
    s = max(abs(u_l), abs(u_r)) + c
    g_l, g_r = n_l * u_l, n_r * u_r
    return 0.5 * (g_l * u_l + g_r * u_r + c * c * (n_l + n_r) - s * (g_r - g_l))


@compiled(**FAST)
def velocities(gas, model):
    """u = flux/n everywhere; masked cells beside the exit repeat the plume's u, for zero slopes."""
    for i in range(gas.n.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            per_n = 1.0 / gas.n[i, j]
            gas.u_z[i, j] = gas.flux_z[i, j] * per_n
            gas.u_r[i, j] = gas.flux_r[i, j] * per_n
    i = model.exit_column
    for j in range(model.lower[i], model.upper[i]):
        if j < model.lower[i - 1] or j >= model.upper[i - 1]:
            gas.n[i - 1, j] = gas.n[i, j]
            gas.neutrals[i - 1, j] = gas.neutrals[i, j]
            gas.u_z[i - 1, j] = gas.u_z[i, j]
            gas.u_r[i - 1, j] = gas.u_r[i, j]


@compiled(**FAST)
def axial_slopes(q, slope, lower, upper):
    """Half slopes along z; zero at the ends of the domain."""
    last = q.shape[0] - 1
    for i in range(last + 1):
        before, after = max(i - 1, 0), min(i + 1, last)
        for j in range(lower[i], upper[i]):
            slope[i, j] = half_slope(q[before, j], q[i, j], q[after, j])


@compiled(**FAST)
def radial_slopes(q, slope, lower, upper):
    """Half slopes along r; zero beside the walls."""
    for i in range(q.shape[0]):
        slope[i, lower[i]] = slope[i, upper[i] - ONE] = 0.0
        for j in range(lower[i] + ONE, upper[i] - ONE):
            slope[i, j] = half_slope(q[i, j - ONE], q[i, j], q[i, j + ONE])


@compiled(**FAST)
def axial_fluxes(gas, model, slopes, fluxes):
    """Fluxes between columns i - 1 and i."""
    n, u, v, nn = gas.n, gas.u_z, gas.u_r, gas.neutrals
    s_n, s_u, s_v, s_nn = slopes.n, slopes.u_z, slopes.u_r, slopes.neutrals
    f_n, f_z, f_r, f_nn = fluxes.n, fluxes.z, fluxes.r, fluxes.neutrals
    c, speed = np.sqrt(model.ion_sound_squared), model.neutral_speed
    for i in range(1, n.shape[0]):
        h = i - 1
        start = max(model.lower[h], model.lower[i])
        stop = min(model.upper[h], model.upper[i])
        for j in range(start, stop):
            f_n[i, j] = mass_flux(
                n[h, j] + s_n[h, j], u[h, j] + s_u[h, j],
                n[i, j] - s_n[i, j], u[i, j] - s_u[i, j], c,
            )  # fmt: skip
        for j in range(start, stop):
            f_z[i, j] = momentum_flux(
                n[h, j] + s_n[h, j], u[h, j] + s_u[h, j],
                n[i, j] - s_n[i, j], u[i, j] - s_u[i, j], c,
            )  # fmt: skip
        for j in range(start, stop):
            before, after = v[h, j] + s_v[h, j], v[i, j] - s_v[i, j]
            f_r[i, j] = f_n[i, j] * (before if f_n[i, j] > 0.0 else after)
        for j in range(start, stop):
            f_nn[i, j] = speed * (nn[h, j] + s_nn[h, j])


@compiled(**FAST)
def anode_fluxes(gas, model, fluxes):
    """Ions leave at the Bohm speed or faster and return as neutrals, also injected here."""
    c = np.sqrt(model.ion_sound_squared)
    bohm = np.sqrt(model.electron_sound_squared * model.boundary_T_e_eV)
    for j in range(model.lower[0], model.upper[0]):
        n, u = gas.n[0, j], gas.u_z[0, j]
        outside = min(u, -bohm)
        flux = mass_flux(n, outside, n, u, c)
        fluxes.n[0, j] = flux
        fluxes.z[0, j] = momentum_flux(n, outside, n, u, c)
        fluxes.r[0, j] = flux * gas.u_r[0, j]
        fluxes.neutrals[0, j] = model.neutral_inflow - flux


@compiled(**FAST)
def cathode_fluxes(gas, model, fluxes):
    """Neutrals and ions leave freely, no ion enters; returns atoms and ions lost per second."""
    total, end = 0.0, gas.n.shape[0]
    for j in range(model.lower[end - 1], model.upper[end - 1]):
        n, u = gas.n[end - 1, j], max(gas.u_z[end - 1, j], 0.0)
        fluxes.n[end, j] = n * u
        fluxes.z[end, j] = n * (u * u + model.ion_sound_squared)
        fluxes.r[end, j] = n * u * gas.u_r[end - 1, j]
        fluxes.neutrals[end, j] = model.neutral_speed * gas.neutrals[end - 1, j]
        total += model.area[j] * (fluxes.n[end, j] + fluxes.neutrals[end, j])
    return total


@compiled(**FAST)
def front_fluxes(gas, model, fluxes, wall):
    """The thruster's front face beside the exit: ions that reach it return as neutrals."""
    i = model.exit_column
    for j in range(model.lower[i], model.upper[i]):
        if model.lower[i - 1] <= j < model.upper[i - 1]:
            continue
        n, u = gas.n[i, j], min(gas.u_z[i, j], 0.0)
        fluxes.n[i, j] = n * u
        fluxes.z[i, j] = n * (u * u + model.ion_sound_squared)
        fluxes.r[i, j] = n * u * gas.u_r[i, j]
        fluxes.neutrals[i, j] = -n * u
        wall[i] -= 0.5 * model.area[j] * n * u / model.dz


@compiled(**FAST)
def radial_fluxes(gas, model, T_e, slopes, fluxes):
    """Fluxes between rows j - 1 and j, times the perimeter."""
    n, u, v, nn = gas.n, gas.u_r, gas.u_z, gas.neutrals
    s_n, s_u, s_v = slopes.n, slopes.u_r, slopes.u_z
    f_n, f_z, f_r, f_nn = fluxes.n, fluxes.z, fluxes.r, fluxes.neutrals
    size, spread = model.perimeter, model.neutral_diffusion / model.dr
    for i in range(n.shape[0]):
        c = np.sqrt(model.electron_sound_squared * T_e[i] + model.ion_sound_squared)
        start, stop = model.lower[i] + ONE, model.upper[i]
        for j in range(start, stop):
            k = j - ONE
            f_n[i, j] = size[j] * mass_flux(
                n[i, k] + s_n[i, k], u[i, k] + s_u[i, k],
                n[i, j] - s_n[i, j], u[i, j] - s_u[i, j], c,
            )  # fmt: skip
        for j in range(start, stop):
            k = j - ONE
            f_r[i, j] = size[j] * momentum_flux(
                n[i, k] + s_n[i, k], u[i, k] + s_u[i, k],
                n[i, j] - s_n[i, j], u[i, j] - s_u[i, j], c,
            )  # fmt: skip
        for j in range(start, stop):
            k = j - ONE
            before, after = v[i, k] + s_v[i, k], v[i, j] - s_v[i, j]
            f_z[i, j] = f_n[i, j] * (before if f_n[i, j] > 0.0 else after)
        for j in range(start, stop):
            k = j - ONE
            f_nn[i, j] = size[j] * spread * (nn[i, k] - nn[i, j])


@compiled(**FAST)
def wall_fluxes(gas, model, T_e, fluxes, wall):
    """Fluxes to the channel walls.

    By the exact rarefaction into the wall, ions reach it at the speed of sound. They return as
    neutrals.
    """
    for i in range(model.exit_column):
        c = np.sqrt(model.electron_sound_squared * T_e[i] + model.ion_sound_squared)
        for outward in (-1.0, 1.0):
            face = model.upper[i] if outward > 0.0 else model.lower[i]
            j = face - ONE if outward > 0.0 else face
            n, u = gas.n[i, j], outward * gas.u_r[i, j]
            if u < c:
                n, u = n * np.exp(u / c - 1.0), c
            flux = outward * model.perimeter[face] * n * u
            fluxes.n[i, face] = flux
            fluxes.r[i, face] = model.perimeter[face] * n * (u * u + c * c)
            fluxes.z[i, face] = flux * gas.u_z[i, j]
            fluxes.neutrals[i, face] = -flux
            wall[i] += 0.5 * outward * flux


@compiled(**FAST)
def side_fluxes(gas, model, T_e, fluxes, side):
    """Fluxes through the sides of the plume: ions leave freely, neutrals diffuse into vacuum.

    Returns the atoms lost per m and second, summed over the columns.
    """
    atoms = 0.0
    for i in range(model.exit_column, gas.n.shape[0]):
        c2 = model.electron_sound_squared * T_e[i] + model.ion_sound_squared
        for outward in (-1.0, 1.0):
            face = model.upper[i] if outward > 0.0 else model.lower[i]
            j = face - ONE if outward > 0.0 else face
            n, u = gas.n[i, j], max(outward * gas.u_r[i, j], 0.0)
            flux = outward * model.perimeter[face] * n * u
            diffused = model.perimeter[face] * SIDE_SPEED * model.neutral_speed * gas.neutrals[i, j]
            fluxes.n[i, face] = flux
            fluxes.r[i, face] = model.perimeter[face] * n * (u * u + c2)
            fluxes.z[i, face] = flux * gas.u_z[i, j]
            fluxes.neutrals[i, face] = outward * diffused
            side[i] += 0.5 * outward * flux
            atoms += diffused
    return atoms


@compiled(**FAST)
def divergence(axial, radial, model, out):
    """Net inflow per volume in both directions."""
    per_dz, per_area = 1.0 / model.dz, model.per_area
    for i in range(out.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            along = (axial[i, j] - axial[i + 1, j]) * per_dz
            out[i, j] = along + (radial[i, j] - radial[i, j + ONE]) * per_area[j]


@compiled(**FAST)
def update(gas, new, state, model, rates, born, old, dt):
    """new = old * new + (1 - old) * (gas + dt * (rates + sources))."""
    n, g_z, g_r, nn, E = gas.n, gas.flux_z, gas.flux_r, gas.neutrals, state.E
    new_n, new_z, new_r, new_nn = new.n, new.flux_z, new.flux_r, new.neutrals
    r_n, r_z, r_r, r_nn = rates.n, rates.z, rates.r, rates.neutrals
    size, per_area, fresh = model.perimeter, model.per_area, 1.0 - old
    charge, slow = E_CHARGE / model.ion_mass, model.neutral_speed
    for i in range(n.shape[0]):
        c2 = model.electron_sound_squared * state.T_e_eV[i] + model.ion_sound_squared
        lower, upper, rate = model.lower[i], model.upper[i], state.ionization[i]
        for j in range(lower, upper):
            born[j] = rate * n[i, j] * nn[i, j]
        for j in range(lower, upper):
            new_n[i, j] = old * new_n[i, j] + fresh * (n[i, j] + dt * (r_n[i, j] + born[j]))
        for j in range(lower, upper):
            push = charge * n[i, j] * E[i, j] + born[j] * slow
            new_z[i, j] = old * new_z[i, j] + fresh * (g_z[i, j] + dt * (r_z[i, j] + push))
        for j in range(lower, upper):
            push = c2 * n[i, j] * (size[j + ONE] - size[j]) * per_area[j]
            new_r[i, j] = old * new_r[i, j] + fresh * (g_r[i, j] + dt * (r_r[i, j] + push))
        for j in range(lower, upper):
            new_nn[i, j] = old * new_nn[i, j] + fresh * (nn[i, j] + dt * (r_nn[i, j] - born[j]))


@compiled(**FAST)
def heavy_stage(gas, new, state, model, work, old, dt):
    """One Euler step of `gas` over dt, mixed into `new` with weight 1 - old."""
    lower, upper, slopes, T_e = model.lower, model.upper, work.slopes, state.T_e_eV
    axial, radial, rates = work.axial, work.radial, work.rates
    axial_slopes(gas.n, slopes.n, lower, upper)
    axial_slopes(gas.u_z, slopes.u_z, lower, upper)
    axial_slopes(gas.u_r, slopes.u_r, lower, upper)
    axial_slopes(gas.neutrals, slopes.neutrals, lower, upper)
    axial_fluxes(gas, model, slopes, axial)
    anode_fluxes(gas, model, axial)
    leaving = cathode_fluxes(gas, model, axial)
    front_fluxes(gas, model, axial, state.wall)
    radial_slopes(gas.n, slopes.n, lower, upper)
    radial_slopes(gas.u_z, slopes.u_z, lower, upper)
    radial_slopes(gas.u_r, slopes.u_r, lower, upper)
    radial_fluxes(gas, model, T_e, slopes, radial)
    wall_fluxes(gas, model, T_e, radial, state.wall)
    atoms = side_fluxes(gas, model, T_e, radial, state.side)
    state.left[0] += 0.5 * dt * (leaving + model.dz * atoms)
    divergence(axial.n, radial.n, model, rates.n)
    divergence(axial.z, radial.z, model, rates.z)
    divergence(axial.r, radial.r, model, rates.r)
    divergence(axial.neutrals, radial.neutrals, model, rates.neutrals)
    update(gas, new, state, model, rates, work.born, old, dt)


@compiled(**FAST)
def heavy_step(state, model, dt, work):
    """One SSP-RK2 (Heun) step of ions and neutrals in a frozen field."""
    state.wall[:] = 0.0
    state.side[:] = 0.0
    heavy_stage(state.gas, state.stage, state, model, work, 0.0, dt)
    velocities(state.stage, model)
    heavy_stage(state.stage, state.gas, state, model, work, 0.5, dt)
    velocities(state.gas, model)
    state.left[0] += dt * model.dz * state.side.sum()
