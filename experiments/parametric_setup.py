"""From the config of `+exp=parametric` to operating points, cases and how to treat them."""

from copy import deepcopy
from typing import cast

from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from ep2sindy.constraints.relations import constraint
from ep2sindy.data.trajectory import ConstantStateError
from ep2sindy.library.library import Library, polynomial
from ep2sindy.studies.parametric.oscillation import OSCILLATING, STEADY, PointData, point_label
from ep2sindy.studies.parametric.points import Case, Study
from experiments.build import (
    check_library,
    inputs_of,
    open_prepared_field,
    recipe_of,
    relations_of,
    terms_of,
)

WITHOUT_OSCILLATION = (STEADY, "decaying", "diverged")  # what a simulation says of itself


def study_of(config: DictConfig) -> Study:
    """Cases, searching and the rest, built before any data are opened."""
    library, terms = terms_of(config.model, states=config.trajectory.states)
    check_library("library", config.library)
    if set(config.library) > {"variables", "degree", "products"}:
        raise ValueError(
            "library may have variables, degree and products, the same for every point: "
            f"{sorted(map(str, config.library))} came"
        )
    return Study(
        library=library,
        cases=_cases(config, library, terms),
        bootstrap=instantiate(config.bootstrap, _target_="ep2sindy.TimeBootstrap"),
        refining=instantiate(config.refining, _target_="ep2sindy.Refining"),
        searched=_searched_library(config),
        recipe=recipe_of(config),
    )


def _searched_library(config: DictConfig) -> Library:
    case = config.library
    products = list(case.get("products", []))
    return polynomial(list(case.variables), degree=case.degree, products=products)


def _cases(config: DictConfig, library: Library, terms: dict[str, list[str]]) -> dict[str, Case]:
    if not isinstance(config.cases, DictConfig) or not config.cases:
        raise ValueError(
            "cases must be like {free: {relations: [], quantities: {k: {coefficient: 'x: x'}}}}: "
            f"{config.cases!r} came"
        )
    found = {}
    for key, case in config.cases.items():
        name = str(key)
        if not isinstance(case, DictConfig) or set(case) != {"relations", "quantities"}:
            raise ValueError(f"cases.{name} must have relations and quantities: {case!r} came")
        relations = case.relations and relations_of(case.relations, key=f"cases.{name}.relations")
        quantities = {
            str(quantity): instantiate(how, _target_="ep2sindy.Quantity")
            for quantity, how in case.quantities.items()
        }
        found[name] = Case(constraint(library, terms, relations), quantities)
    return found


def point_configs(config: DictConfig) -> list[DictConfig]:
    """The config once per operating point, its parameters and data put into the data group.

    Raises ValueError for points without all parameters, or that would open the same data twice.
    """
    names = [str(name) for name in config.parameters]
    if not isinstance(config.points, ListConfig) or not config.points:
        raise ValueError(f"points must be a list with all of {names} each: {config.points!r} came")
    found = [_point_config(config, point, names) for point in config.points]
    seen: dict[str, str] = {}
    for point, each in zip(config.points, found, strict=True):
        label = point_label(parameters_of(point, names))
        data = OmegaConf.to_yaml(each.data, sort_keys=True)
        if label in seen.values():
            raise ValueError(f"an operating point may come once: {label} comes again")
        if data in seen:
            raise ValueError(
                f"operating points must differ in their data: {label} has that of {seen[data]}; "
                "say in parameters where the data group takes them, or give each point its data"
            )
        seen[data] = label
    return found


def _point_config(config: DictConfig, point: DictConfig, names: list[str]) -> DictConfig:
    if not isinstance(point, DictConfig) or set(point) - {"data"} != set(names):
        raise ValueError(f"a point must have {names}, and data where they differ: {point!r} came")
    values = parameters_of(point, names)
    found = deepcopy(config)
    for name, place in config.parameters.items():
        if place is None:
            continue
        if OmegaConf.select(found.data, place) is None:
            raise ValueError(
                f"parameters.{name} must name a number of the data group, or be null: "
                f"data.{place} is none"
            )
        OmegaConf.update(found.data, place, values[str(name)])
    if "data" in point:
        found.data = OmegaConf.merge(found.data, point.data)
    if "progress" in found.data:  # points are simulated side by side: their bars would mix
        found.data.progress = False
    with open_dict(found):
        found.point = values
    return found


def parameters_of(point: DictConfig, names: list[str]) -> dict[str, float]:
    """Raises ValueError for one that is not a number."""
    for name in names:
        if type(point[name]) not in (int, float):
            raise ValueError(f"points must give {name} as a number: {point[name]!r} came")
    return {name: float(point[name]) for name in names}


def opened_point(config: DictConfig) -> PointData:
    """Open or simulate one operating point; what does not oscillate comes without trajectory.

    A state that stays exactly where it is makes a point steady: no trajectory may hold it.
    """
    parameters = cast(dict[str, float], OmegaConf.to_container(config.point))
    libraries = [terms_of(config.model, states=config.trajectory.states)[0]]
    inputs = inputs_of(config, [*libraries, _searched_library(config)])
    to_trajectory = instantiate(config.trajectory, _convert_="all")
    label = point_label(parameters)
    try:
        field = open_prepared_field(config)
        if field.attrs.get("status") in WITHOUT_OSCILLATION:
            return PointData(parameters, None, field.attrs["status"])
        return PointData(parameters, to_trajectory(field, inputs=inputs, label=label), OSCILLATING)
    except ConstantStateError:
        return PointData(parameters, None, STEADY)
    except (ValueError, OSError, HydraException) as error:
        # What a constructor raised reaches us wrapped; other processes hand on plain errors alone.
        own = error.__cause__ if isinstance(error, HydraException) else None
        raise ValueError(f"operating point {label}: {own or error}") from error
