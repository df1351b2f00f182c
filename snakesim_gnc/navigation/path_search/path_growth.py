"""The interface of what grows the paths of a search. It has two implementations with the same results."""

from abc import ABC, abstractmethod

from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask


class PathExpander(ABC):
    """The paths of one search, which grow by one arc at a time."""

    @abstractmethod
    def __init__(
        self,
        obstacles: ObstacleGrid,
        parameters: SearchParameters,
        task: SearchTask,
        start_nodes: NodeLayer,
        max_arc_count: int,
    ) -> None:
        """Prepare a search, in which the start nodes are the first and only layer.

        Every implementation has this constructor, so that a search can choose the class.

        Args:
            obstacles: The map.
            parameters: Size of the robot's body, and the cost weights.
            task: Direction of travel, and how the body lies before the search.
            start_nodes: The nodes from which the paths grow: places of the head without contacts.
            max_arc_count: Maximum number of arcs of a path, which is the maximum number of calls of `expand_layer`.
        """

    @property
    @abstractmethod
    def node_count(self) -> int:
        """Return the number of nodes in the newest layer."""

    @abstractmethod
    def expand_layer(self) -> bool:
        """Add the best children of the newest layer as another layer.

        Returns:
            Whether a layer was added; False, without any change, if no arc is free.
        """

    @abstractmethod
    def trace_cheapest(self) -> SearchedPath | None:
        """Return the path to the cheapest node of the newest layer; None if no layer was added to the first one."""
