"""Loops through the handles of a voxel solid, by thinning it without changing its topology.

Voxels are closed cubes: two of them are connected if they share a face, an edge or a corner.
"""

import heapq
import itertools
from collections import deque

import numpy as np
from jaxtyping import Bool, Int

_AROUND = [offset for offset in itertools.product((-1, 0, 1), repeat=3) if any(offset)]
_SHARES = np.abs(np.array(_AROUND)).sum(axis=1)  # 1: a face, 2: an edge, 3: a corner
_STEP = np.abs(np.array(_AROUND)[:, None] - np.array(_AROUND)[None])


def _bits(flags) -> int:
    return sum(1 << int(place) for place in np.flatnonzero(flags))


_FACES = _bits(_SHARES == 1)
_FACES_AND_EDGES = _bits(_SHARES <= 2)
_TOUCHING = [_bits(row) for row in _STEP.max(axis=2) == 1]
_FACING = [_bits(row) & _FACES_AND_EDGES for row in _STEP.sum(axis=2) == 1]


def thin(solid: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Remove voxels, outer ones first, as long as that does not change the topology.

    What remains is homotopy equivalent to the solid with its cavities filled: a voxel for each part without
    handles, closed curves one voxel thick for parts with handles, no loose ends.
    """
    from scipy import ndimage  # on first use: slow to import

    filled = np.pad(np.asarray(ndimage.binary_fill_holes(solid)), 1)
    depth = np.asarray(ndimage.distance_transform_edt(filled)).ravel()
    strides = (filled.shape[1] * filled.shape[2], filled.shape[2], 1)
    around = [int(np.dot(offset, strides)) for offset in _AROUND]
    left = bytearray(filled.ravel().astype(np.uint8))  # plain bytes: single look-ups are much faster
    known: dict[int, bool] = {}

    queue = [(depth[place], place) for place in np.flatnonzero(filled.ravel()).tolist()]
    heapq.heapify(queue)
    waiting = bytearray(left)
    while queue:
        _, place = heapq.heappop(queue)
        waiting[place] = 0
        neighbours = 0
        for bit, offset in enumerate(around):
            neighbours |= left[place + offset] << bit
        if neighbours not in known:
            known[neighbours] = _is_simple(neighbours)
        if known[neighbours]:
            left[place] = 0
            for offset in around:
                near = place + offset
                if left[near] and not waiting[near]:
                    waiting[near] = 1
                    heapq.heappush(queue, (depth[near], near))
    return np.frombuffer(left, bool).reshape(filled.shape)[1:-1, 1:-1, 1:-1]


def _is_simple(neighbours: int) -> bool:
    """Does removing a voxel with these neighbours (a bit each) keep the topology?

    Bertrand and Malandain (1994): its neighbours are connected around it, and so is the empty space that
    faces it, among the 18 places that share a face or an edge with it.
    """
    empty = ~neighbours & _FACES_AND_EDGES
    facing = [part for part in _parts(empty, _FACING) if part & _FACES]
    return len(facing) == 1 and len(_parts(neighbours, _TOUCHING)) == 1


def _parts(cells: int, adjacent: list[int]) -> list[int]:
    """Connected parts of a set of cells."""
    parts = []
    while cells:
        part, fresh = 0, cells & -cells
        while fresh:
            part |= fresh
            grown = 0
            for cell in range(26):
                if fresh >> cell & 1:
                    grown |= adjacent[cell]
            fresh = grown & cells & ~part
        parts.append(part)
        cells &= ~part
    return parts


def handle_loops(solid: Bool[np.ndarray, "X Y Z"]) -> list[Int[np.ndarray, "_ 3"]]:
    """One closed path of voxels for each independent handle of a solid, its cavities filled.

    The paths run through the thinned solid, each voxel sharing at least a corner with the next, the first not
    repeated. They are a shortest basis of its first homology group modulo 2: their number is the solid's
    first Betti number, and every closed curve in the solid is, modulo 2, a sum of them up to what is
    contractible.
    """
    voxels = [tuple(voxel) for voxel in np.argwhere(thin(solid)).tolist()]
    index = {voxel: place for place, voxel in enumerate(voxels)}
    links = [
        [index[near] for x, y, z in _AROUND if (near := (voxel[0] + x, voxel[1] + y, voxel[2] + z)) in index]
        for voxel in voxels
    ]
    edges = {}
    for one, near in enumerate(links):
        for other in near:
            if one < other:
                edges[one, other] = edges[other, one] = 1 << len(edges) // 2

    # Voxels that touch pairwise share a corner. Hence (nerve theorem) a cycle of this graph is contractible
    # in the solid if it is a sum of triangles.
    span: dict[int, int] = {}
    for (one, other), edge in edges.items():
        for third in set(links[one]) & set(links[other]):
            if one < other < third:
                _extend(span, edge ^ edges[other, third] ^ edges[one, third])

    # A shortest cycle that is no sum of others is made of two shortest paths from any of its voxels (Horton,
    # 1987), so trees from the junctions, and from one voxel of each part, find it.
    parts = _first_of_each_part(links)
    wanted = len(edges) // 2 - len(voxels) + len(parts) - len(span)
    roots = parts + [place for place, near in enumerate(links) if len(near) > 2]
    candidates = {}
    for root in roots if wanted else []:
        parent = _tree(links, root)
        for one, other in edges:
            if one < other and one in parent and parent[one] != other and parent[other] != one:
                there, back = _path(parent, one), _path(parent, other)
                if len(set(there) & set(back)) == 1:  # only the root
                    cycle = there[::-1] + back[:-1]
                    candidates.setdefault(frozenset(cycle), cycle)
    loops = []
    for cycle in sorted(candidates.values(), key=len):
        if len(loops) == wanted:
            break
        chain = 0
        for one, other in zip(cycle, cycle[1:] + cycle[:1], strict=True):
            chain ^= edges[one, other]
        if _extend(span, chain):
            loops.append(np.array([voxels[place] for place in cycle]))
    return loops


def _extend(span: dict[int, int], vector: int) -> bool:
    """Add a vector over GF(2), as bits, to a basis in echelon form; was it independent?"""
    while vector:
        lead = vector.bit_length()
        if lead not in span:
            span[lead] = vector
            return True
        vector ^= span[lead]
    return False


def _first_of_each_part(links: list[list[int]]) -> list[int]:
    first, seen = [], set()
    for place in range(len(links)):
        if place not in seen:
            first.append(place)
            seen |= _tree(links, place).keys()
    return first


def _tree(links: list[list[int]], root: int) -> dict[int, int]:
    """Parents in a tree of shortest paths; the root is its own."""
    parent, queue = {root: root}, deque([root])
    while queue:
        place = queue.popleft()
        for near in links[place]:
            if near not in parent:
                parent[near] = place
                queue.append(near)
    return parent


def _path(parent: dict[int, int], place: int) -> list[int]:
    """From a place to the root of a tree."""
    path = [place]
    while parent[place] != place:
        place = parent[place]
        path.append(place)
    return path
