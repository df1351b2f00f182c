"""The interface of what grows the paths of a search. It has two implementations with the same results."""

from abc import ABC, abstractmethod

from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask


class PathGrowth(ABC):
    """The paths of one search, which grow by one arc at a time."""

    @abstractmethod
    def __init__(
        self, obstacles: ObstacleGrid, parameters: SearchParameters, task: SearchTask, start: NodeLayer, steps: int
    ) -> None:
        """Begin with the start nodes as the first layer.

        Args:
            obstacles: the map.
            parameters: the robot, and the costs.
            task: the search.
            start: the nodes from which the paths grow.
            steps: the largest number of arcs.
        """

    @property
    @abstractmethod
    def node_count(self) -> int:
        """Return the number of nodes in the newest layer."""

    @abstractmethod
    def grow(self) -> bool:
        """Add the best children of the newest layer as a layer. Return False, and change nothing, if no arc is free."""

    @abstractmethod
    def trace_cheapest(self) -> SearchedPath | None:
        """Follow the parents of the cheapest node of the newest layer back to the start; None if nothing has grown."""
