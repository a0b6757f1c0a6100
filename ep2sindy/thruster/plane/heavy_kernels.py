"""Ions and neutrals: one SSP-RK2 step in a frozen field, column by column.

Each stage goes over the columns once. In every column four loops along r do the work: fluxes along
z, slopes along r, fluxes along r, and the update. A row holds some tens of cells, so that the start
of a loop counts: loops do as much as the compiler can vectorise, and divide once where they can.
They pass on rows of one column, which the nearest cache holds. Functions that hold one are `LOOP`.
"""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.heavy_kernels import quotients, rusanov
from ep2sindy.thruster.axial.state_kernels import ENTRY, FAST, LOOP, ONE
from ep2sindy.thruster.constants import E_CHARGE
from ep2sindy.thruster.plane.state_kernels import Gas

SIDE_SPEED = 0.5  # of the neutrals' speed: diffusive loss into vacuum (Marshak)


@compiled(inline="always")
def half_slope(left, centre, right):
    """Half the van Leer slope, a*b/(a + b) of the two differences, as numerator and denominator.

    At an extremum it is 0 over 1.
    """
    a, b = centre - left, right - centre
    product = a * b
    return (product, a + b) if product > 0.0 else (0.0, 1.0)


@compiled(**FAST)
def column(gas, i):
    """Rows of one column; only for kernels that count no references to arrays, as this one."""
    return Gas(gas.n[i], gas.flux_z[i], gas.flux_r[i], gas.neutrals[i], gas.u_z[i], gas.u_r[i])


@compiled(**ENTRY)
def velocities(gas, model):
    """u = flux/n everywhere."""
    for i in range(gas.n.shape[0]):
        for j in range(model.lower[i], model.upper[i]):
            per_n = 1.0 / gas.n[i, j]
            gas.u_z[i, j] = gas.flux_z[i, j] * per_n
            gas.u_r[i, j] = gas.flux_r[i, j] * per_n
    repeat_exit(gas, model)


@compiled(**FAST)
def repeat_exit(gas, model):
    """Masked cells next to the exit repeat the plume's, for zero slopes."""
    i = model.exit_column
    for j in range(model.lower[i], model.upper[i]):
        if j < model.lower[i - 1] or j >= model.upper[i - 1]:
            gas.n[i - 1, j] = gas.n[i, j]
            gas.neutrals[i - 1, j] = gas.neutrals[i, j]
            gas.u_z[i - 1, j] = gas.u_z[i, j]
            gas.u_r[i - 1, j] = gas.u_r[i, j]


@compiled(**LOOP)
def axial_fluxes(here, behind, beyond, slopes, fluxes, start, stop, model):
    """Fluxes between one column and the one behind it.

    slopes: those of this column; they become those of the one behind, for which the one beyond is
    needed.
    """
    c2, speed = model.ion_sound_squared, model.neutral_speed
    c = np.sqrt(c2)
    for j in range(start, stop):
        a, p = half_slope(here.n[j], behind.n[j], beyond.n[j])
        b, q = half_slope(here.u_z[j], behind.u_z[j], beyond.u_z[j])
        d, r = half_slope(here.u_r[j], behind.u_r[j], beyond.u_r[j])
        e, s = half_slope(here.neutrals[j], behind.neutrals[j], beyond.neutrals[j])
        s_n, s_u, s_v, s_nn = quotients(a, p, b, q, d, r, e, s)
        flux, fluxes.z[j] = rusanov(
            here.n[j] + slopes.n[j], here.u_z[j] + slopes.u_z[j],
            behind.n[j] - s_n, behind.u_z[j] - s_u, c2, c,
        )  # fmt: skip
        fluxes.n[j] = flux
        fluxes.r[j] = flux * (here.u_r[j] + slopes.u_r[j] if flux > 0.0 else behind.u_r[j] - s_v)
        fluxes.neutrals[j] = speed * (here.neutrals[j] + slopes.neutrals[j])
        slopes.n[j], slopes.u_z[j], slopes.u_r[j], slopes.neutrals[j] = s_n, s_u, s_v, s_nn


@compiled(**FAST)
def anode_fluxes(here, model, fluxes):
    """Ions leave at the Bohm speed or faster and return as neutrals, also injected here."""
    c2 = model.ion_sound_squared
    bohm = np.sqrt(model.electron_sound_squared * model.boundary_T_e_eV)
    for j in range(model.lower[0], model.upper[0]):
        n, u = here.n[j], here.u_z[j]
        fluxes.n[j], fluxes.z[j] = rusanov(n, min(u, -bohm), n, u, c2, np.sqrt(c2))
        fluxes.r[j] = fluxes.n[j] * here.u_r[j]
        fluxes.neutrals[j] = model.neutral_inflow - fluxes.n[j]


@compiled(**FAST)
def cathode_fluxes(here, model, fluxes):
    """Neutrals and ions leave freely, no ion enters; returns atoms and ions lost per second."""
    total, last = 0.0, model.lower.size - 1
    for j in range(model.lower[last], model.upper[last]):
        n, u = here.n[j], max(here.u_z[j], 0.0)
        fluxes.n[j] = n * u
        fluxes.z[j] = n * (u * u + model.ion_sound_squared)
        fluxes.r[j] = n * u * here.u_r[j]
        fluxes.neutrals[j] = model.neutral_speed * here.neutrals[j]
        total += model.area[j] * (fluxes.n[j] + fluxes.neutrals[j])
    return total


@compiled(**FAST)
def front_fluxes(plume, model, fluxes):
    """The thruster's front face next to the exit: ions that reach it return as neutrals.

    plume: its first column. Returns ions lost per second.
    """
    i, lost = model.exit_column, 0.0
    for j in range(model.lower[i], model.upper[i]):
        if model.lower[i - 1] <= j < model.upper[i - 1]:
            continue
        n, u = plume.n[j], min(plume.u_z[j], 0.0)
        fluxes.n[j] = n * u
        fluxes.z[j] = n * (u * u + model.ion_sound_squared)
        fluxes.r[j] = n * u * plume.u_r[j]
        fluxes.neutrals[j] = -n * u
        lost -= model.area[j] * n * u
    return lost


@compiled(**LOOP)
def radial_slopes(here, slopes, start, stop):
    """Half slopes along r of ions and their velocities; zero next to the walls."""
    last = stop - ONE
    slopes.n[start] = slopes.u_z[start] = slopes.u_r[start] = 0.0
    slopes.n[last] = slopes.u_z[last] = slopes.u_r[last] = 0.0
    for j in range(start + ONE, last):
        k, m = j - ONE, j + ONE
        a, p = half_slope(here.n[k], here.n[j], here.n[m])
        b, q = half_slope(here.u_z[k], here.u_z[j], here.u_z[m])
        c, r = half_slope(here.u_r[k], here.u_r[j], here.u_r[m])
        slopes.n[j], slopes.u_z[j], slopes.u_r[j], _ = quotients(a, p, b, q, c, r, 0.0, 1.0)


@compiled(**LOOP)
def radial_fluxes(here, slopes, fluxes, start, stop, c, model):
    """Fluxes between rows j - 1 and j, times the perimeter."""
    spread = model.neutral_diffusion / model.dr
    for j in range(start + ONE, stop):
        k, size = j - ONE, model.perimeter[j]
        n, r = rusanov(
            here.n[k] + slopes.n[k], here.u_r[k] + slopes.u_r[k],
            here.n[j] - slopes.n[j], here.u_r[j] - slopes.u_r[j], c * c, c,
        )  # fmt: skip
        z = n * (here.u_z[k] + slopes.u_z[k] if n > 0.0 else here.u_z[j] - slopes.u_z[j])
        fluxes.n[j], fluxes.z[j], fluxes.r[j] = size * n, size * z, size * r
        fluxes.neutrals[j] = size * spread * (here.neutrals[k] - here.neutrals[j])


@compiled(**FAST)
def wall_fluxes(here, model, i, c, fluxes):
    """Fluxes from a column of the channel to its walls; returns the ions lost per m and second.

    By the exact rarefaction into the wall, ions reach it at the speed of sound. They return as
    neutrals.
    """
    lost = 0.0
    for outward in (-1.0, 1.0):
        face = model.upper[i] if outward > 0.0 else model.lower[i]
        j = face - ONE if outward > 0.0 else face
        n, u = here.n[j], outward * here.u_r[j]
        if u < c:
            n, u = n * np.exp(u / c - 1.0), c
        flux = outward * model.perimeter[face] * n * u
        fluxes.n[face] = flux
        fluxes.r[face] = model.perimeter[face] * n * (u * u + c * c)
        fluxes.z[face] = flux * here.u_z[j]
        fluxes.neutrals[face] = -flux
        lost += outward * flux
    return lost


@compiled(**FAST)
def side_fluxes(here, model, i, c, fluxes):
    """Fluxes from a column of the plume through its sides: ions leave freely, neutrals diffuse.

    Returns the ions and the atoms lost per m and second.
    """
    ions = atoms = 0.0
    for outward in (-1.0, 1.0):
        face = model.upper[i] if outward > 0.0 else model.lower[i]
        j = face - ONE if outward > 0.0 else face
        n, u = here.n[j], max(outward * here.u_r[j], 0.0)
        flux = outward * model.perimeter[face] * n * u
        diffused = model.perimeter[face] * SIDE_SPEED * model.neutral_speed * here.neutrals[j]
        fluxes.n[face] = flux
        fluxes.r[face] = model.perimeter[face] * n * (u * u + c * c)
        fluxes.z[face] = flux * here.u_z[j]
        fluxes.neutrals[face] = outward * diffused
        ions += outward * flux
        atoms += diffused
    return ions, atoms


@compiled(**LOOP)
def update(here, new, E, before, behind, radial, start, stop, c2, rate, old, dt, model):
    """new = old * new + (1 - old) * (here + dt * (net inflow + sources)), and its velocities.

    before, behind: fluxes along z through the faces of this column.
    """
    per_dz, size, per_area, fresh = 1.0 / model.dz, model.perimeter, model.per_area, 1.0 - old
    charge, slow = E_CHARGE / model.ion_mass, model.neutral_speed
    for j in range(start, stop):
        m, n, per = j + ONE, here.n[j], per_area[j]
        born = rate * n * here.neutrals[j]
        momentum_gain_z = charge * n * E[j] + born * slow
        momentum_gain_r = c2 * n * (size[m] - size[j]) + radial.r[j] - radial.r[m]
        d_n = (before.n[j] - behind.n[j]) * per_dz + (radial.n[j] - radial.n[m]) * per + born
        d_z = (
            (before.z[j] - behind.z[j]) * per_dz
            + (radial.z[j] - radial.z[m]) * per
            + momentum_gain_z
        )
        d_r = (before.r[j] - behind.r[j]) * per_dz + momentum_gain_r * per
        d_nn = (before.neutrals[j] - behind.neutrals[j]) * per_dz - born
        d_nn += (radial.neutrals[j] - radial.neutrals[m]) * per
        next_n = old * new.n[j] + fresh * (n + dt * d_n)
        next_z = old * new.flux_z[j] + fresh * (here.flux_z[j] + dt * d_z)
        next_r = old * new.flux_r[j] + fresh * (here.flux_r[j] + dt * d_r)
        per_n = 1.0 / next_n
        new.n[j], new.flux_z[j], new.flux_r[j] = next_n, next_z, next_r
        new.u_z[j], new.u_r[j] = next_z * per_n, next_r * per_n
        new.neutrals[j] = old * new.neutrals[j] + fresh * (here.neutrals[j] + dt * d_nn)


@compiled(**FAST)
def fluxes_behind(i, gas, state, model, slopes, fluxes):
    """Fluxes from a column to the one behind it; returns atoms and ions that leave per second."""
    here, last = column(gas, i), gas.n.shape[0] - 1
    if i == last:
        return cathode_fluxes(here, model, fluxes)
    behind, beyond = column(gas, i + 1), column(gas, min(i + 2, last))  # read, perhaps the same
    start, stop = model.lower[i + 1], model.upper[i + 1]
    axial_fluxes(here, behind, beyond, slopes, fluxes, start, stop, model)
    if i + 1 == model.exit_column:
        state.wall[i + 1] += 0.5 * front_fluxes(behind, model, fluxes) / model.dz
    return 0.0


@compiled(**FAST)
def outer_fluxes(i, here, state, model, c, fluxes):
    """Fluxes to the walls or through the sides; returns atoms and ions that leave per second."""
    if i < model.exit_column:
        state.wall[i] += 0.5 * wall_fluxes(here, model, i, c, fluxes)
        return 0.0
    ions, atoms = side_fluxes(here, model, i, c, fluxes)
    state.side[i] += 0.5 * ions
    return model.dz * (ions + atoms)


@compiled(**FAST)
def heavy_stage(gas, new, state, model, work, old, dt):
    """One Euler step of `gas` over dt, mixed into `new` with weight 1 - old."""
    before, behind, along, radial = work.before, work.behind, work.slopes_z, work.radial
    for slope in along:  # zero at the ends of the domain
        slope[:] = 0.0
    anode_fluxes(column(gas, 0), model, before)
    left = 0.0
    for i in range(gas.n.shape[0]):
        here, start, stop = column(gas, i), model.lower[i], model.upper[i]
        c2 = model.electron_sound_squared * state.T_e_eV[i] + model.ion_sound_squared
        c = np.sqrt(c2)
        left += fluxes_behind(i, gas, state, model, along, behind)
        radial_slopes(here, work.slopes_r, start, stop)
        radial_fluxes(here, work.slopes_r, radial, start, stop, c, model)
        left += outer_fluxes(i, here, state, model, c, radial)
        update(
            here, column(new, i), state.E[i], before, behind, radial, start, stop, c2,
            state.ionization[i], old, dt, model,
        )  # fmt: skip
        before, behind = behind, before
    repeat_exit(new, model)
    state.left[0] += 0.5 * dt * left


@compiled(**ENTRY)
def heavy_step(state, model, dt, work):
    """One SSP-RK2 (Heun) step of ions and neutrals in a frozen field."""
    state.wall[:] = 0.0
    state.side[:] = 0.0
    gas, new, old = state.gas, state.stage, 0.0
    for _ in range(2):  # one copy of the code for both stages
        heavy_stage(gas, new, state, model, work, old, dt)
        gas, new, old = new, gas, 0.5
