"""Relations between coefficients of which some may be absent: what they ask of a support."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from ep2sindy.constraints.relations import Relation, parse_relation
from ep2sindy.library.library import Library


def relations_of(relations: Sequence[Relation | str]) -> tuple[Relation, ...]:
    """Relations from texts or as they are."""
    return tuple(parse_relation(r) if isinstance(r, str) else r for r in relations)


def binding(
    relations: Sequence[Relation], support: Mapping[str, Sequence[str]]
) -> tuple[Relation, ...] | None:
    """The relations that a support has the terms for; None where it breaks one.

    A relation without a value holds where all of its terms are absent; with some of them absent,
    it would take the others away as well.
    """
    found = []
    for relation in relations:
        present = [term in support.get(state, ()) for _, state, term in relation.factors]
        if all(present):
            found.append(relation)
        elif any(present) or relation.value != 0.0:
            return None
    return tuple(found)


def completed(
    masks: Bool[np.ndarray, "supports terms"],
    library: Library,
    equation: str,
    relations: Sequence[Relation],
) -> Bool[np.ndarray, "_ terms"]:
    """Supports of one equation, and the same with what relations ask of it, each once.

    Terms whose relation has a value are in all; those of a relation without one, all or none.
    Raises ValueError for a term that the library does not have.
    """
    for relation in relations:
        named = [library.index(t) for _, state, t in relation.factors if state == equation]
        if not named:
            continue
        whole = masks.copy()
        whole[:, named] = True
        without = masks[~masks[:, named].any(axis=1)]
        masks = whole if relation.value != 0.0 else np.concatenate([without, whole])
    return np.unique(masks, axis=0)
