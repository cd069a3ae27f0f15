# SPDX-License-Identifier: Apache-2.0
"""Places beyond one map: of many sessions and robots, in a database that they share."""

from placerec.place_store.rows import SeenPlace
from placerec.place_store.store import PlaceStore

__all__ = ["PlaceStore", "SeenPlace"]
