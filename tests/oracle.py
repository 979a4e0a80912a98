"""Slow, readable NumPy versions of the kernels, written from the definitions in the headers of `_native`'s groups.

Nothing here is shared with the C code: plain loops over pixels, 64-bit integers or float64 throughout.
"""

import numpy as np

CENSUS_INVALID = 1 << 63
COST_UNSEEN = 32
NO_SLOT = 255
OFFSET_INVALID = np.iinfo(np.int32).min

# (row step, column step) from the pixel before on each of the 8 paths.
DIRECTIONS = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]


def census(padded, valid):
    """Census words (H, W) uint64 of an image, in 1/64 grey value, with a border of 3 rows and 4 columns."""
    words = np.empty(valid.shape, dtype=np.uint64)
    for y, x in np.ndindex(valid.shape):
        window = padded[y : y + 7, x : x + 9].ravel().astype(int)
        neighbours = np.delete(window, 31)  # the centre
        bits = [int(neighbour < window[31] - 32) << k for k, neighbour in enumerate(neighbours)]
        words[y, x] = sum(bits) if valid[y, x] else CENSUS_INVALID
    return words


def matching_cost(reference, target, base, depth):
    """Hamming costs (H, W, depth) uint8."""
    cost = np.zeros((*reference.shape, depth), dtype=np.uint8)
    for y, x, i in np.ndindex(cost.shape):
        word = int(reference[y, x])
        column = x + int(base[y, x]) + i
        if word >= CENSUS_INVALID:
            continue
        other = int(target[y, column]) if 0 <= column < target.shape[1] else CENSUS_INVALID
        cost[y, x, i] = COST_UNSEEN if other >= CENSUS_INVALID else (word ^ other).bit_count()
    return cost


def _slots(costs, indices):
    inside = (indices >= 0) & (indices < len(costs))
    return np.where(inside, costs[np.clip(indices, 0, len(costs) - 1)], NO_SLOT)


def spans(reference):
    """(H, W) bool: from the first pixel of a row with content to the last."""
    content = reference & CENSUS_INVALID == 0
    from_left, from_right = (np.logical_or.accumulate(each, axis=1) for each in (content, content[:, ::-1]))
    return from_left & from_right[:, ::-1]


def path_costs(cost, base, image, p1, p2, max_slant, direction, inside=None):
    """L (H, W, D) int64 along one path direction, without any narrowing; paths are cut off outside of `inside`."""
    height, width, depth = cost.shape
    inside = np.ones((height, width), dtype=bool) if inside is None else inside
    rows = range(height) if direction[0] >= 0 else range(height - 1, -1, -1)
    columns = range(width) if direction[1] >= 0 else range(width - 1, -1, -1)
    path = cost.astype(np.int64)
    slot = np.arange(depth)
    for y in rows:
        for x in columns:
            y0, x0 = y - direction[0], x - direction[1]
            if not (0 <= y0 < height and 0 <= x0 < width and inside[y0, x0]):
                continue
            before = path[y0, x0] - path[y0, x0].min()
            difference = int(base[y, x]) - int(base[y0, x0])
            same = slot + (0 if abs(difference) <= max_slant else difference)
            one_step = np.minimum(_slots(before, same - 1), _slots(before, same + 1)) + p1
            jump = int(p2[abs(int(image[y, x]) - int(image[y0, x0]))])
            path[y, x] += np.minimum(np.minimum(_slots(before, same), one_step), jump)
    return path


def aggregation(cost, base, image, p1, p2, max_slant, inside=None):
    """Half of the sum of the 8 paths, rounded up, (H, W, D) int64; it and what four paths add end at 255."""
    given = cost, base, image, p1, p2, max_slant
    detours = [path_costs(*given, direction, inside) - cost for direction in DIRECTIONS]
    forward, backward = (np.minimum(sum(half), 255) for half in (detours[:4], detours[4:]))
    return np.minimum((forward + backward + 1) // 2 + 4 * cost.astype(np.int64), 255)


def subpixel_offset(before, best, after):
    """Equiangular fit in 1/256 pixel, rounded towards zero; a cost of zero is a match at the whole pixel."""
    rise = max(before, after) - best
    return 0 if rise <= 0 or best == 0 else int(np.trunc((before - after) * 128 / rise))


def _source_columns_shown(columns, source_width):
    """Of every target pixel of a row the columns of the source that it stands for.

    Its own, and the one to three that follow where its neighbour on the right shows the next but so many; none
    outside of the source.
    """
    shown = []
    for w, column in enumerate(map(int, columns)):
        step = int(columns[w + 1]) - column if w + 1 < len(columns) else 1
        stretch = range(column, column + (step if 1 < step <= 4 else 1)) if column >= 0 else []
        shown.append([c for c in stretch if c < source_width])
    return shown


def _rivals(least, columns, source_width):
    """Of every target pixel the one that its winners are checked against.

    `least` are the least sums that point at target pixels, by their number. It is the first one with the least sum
    of those that stand for the same column of the source; itself where it shows none.
    """
    standing: dict = {}  # column of the source: target pixels
    for w, shown in enumerate(_source_columns_shown(columns, source_width)):
        for column in shown if w in least else []:
            standing.setdefault(column, []).append(w)
    return [
        min(standing.get(column, [w]), key=lambda rival: (least.get(rival), rival))
        for w, column in enumerate(map(int, columns))
    ]


def selection(aggregated, base, reference, target, columns, source_width, max_difference, max_excess):
    """Offsets (H, W) int32 in 1/256 pixel, OFFSET_INVALID = none."""
    height, width, depth = aggregated.shape
    offsets = np.full((height, width), OFFSET_INVALID, dtype=np.int32)
    for y in range(height):
        content = [x for x in range(width) if int(reference[y, x]) < CENSUS_INVALID]
        votes: dict = {}  # column in the target: sums, columns in the reference
        for x in content:
            for i in range(depth):
                r = x + int(base[y, x]) + i
                if 0 <= r < target.shape[1]:
                    votes.setdefault(r, []).append((int(aggregated[y, x, i]), x))
        least = {r: min(votes[r])[0] for r in votes}
        rivals = _rivals(least, columns[y], source_width)
        for x in content:
            sums = aggregated[y, x].astype(int)
            best = int(np.argmin(sums))
            r = x + int(base[y, x]) + best
            if best in (0, depth - 1) or r not in votes or int(target[y, r]) >= CENSUS_INVALID:
                continue
            rival = rivals[r]
            near = any(vote == least[rival] and abs(column - x) <= max_difference for vote, column in votes[rival])
            if sums[best] - least[rival] <= max_excess or near:
                offsets[y, x] = (r - x) * 256 + subpixel_offset(*(int(s) for s in sums[best - 1 : best + 2]))
    return offsets


def warp(source, valid, prediction, margin, target_width):
    """Warped image, its content and the nearest columns of the source, (H, target_width) each."""
    height, source_width = source.shape
    width = prediction.shape[1]
    warped = np.zeros((height, target_width))
    content = np.zeros((height, target_width), dtype=np.uint8)
    columns = np.full((height, target_width), -1, dtype=np.int32)
    for y, w in np.ndindex(warped.shape):
        x = w - margin
        place = 256 * x + int(prediction[y, min(max(x, 0), width - 1)])  # 1/256 pixel of the source
        nearest = (place + 128) // 256
        if 0 <= nearest < source_width:
            columns[y, w] = nearest
        if source_width:
            before, after = (min(max(k, 0), source_width - 1) for k in (place // 256, -(-place // 256)))
            share = place % 256 / 256
            warped[y, w] = (1 - share) * float(source[y, before]) + share * float(source[y, after])
            content[y, w] = min(valid[y, before], valid[y, after]) if columns[y, w] >= 0 else 0
    return warped, content, columns


def unwarp_offsets(offset, prediction, margin):
    """Offsets (H, W) int32 to the source of a warp, 1/256 pixel, of those to what it warped."""
    height, width = offset.shape
    unwarped = np.full(offset.shape, OFFSET_INVALID, dtype=np.int32)
    for y, x in np.ndindex(height, width):
        if offset[y, x] == OFFSET_INVALID:
            continue
        residual = int(offset[y, x]) - 256 * margin
        place = 256 * x + residual  # column of the reference whose prediction counts, 1/256 pixel
        part = place % 256
        here, beside = (int(prediction[y, min(max(place // 256 + k, 0), width - 1)]) for k in (0, 1))
        if abs(beside - here) <= 4 * 256:
            predicted = here + (beside - here) * part // 256
        else:
            predicted = here if part < 128 else beside
        if abs(residual + predicted) < 1 << 24:
            unwarped[y, x] = residual + predicted
    return unwarped


def mean_offsets(offset, radius, max_step):
    """Mean (H, W) int32 of the offsets of a window that differ from its middle by no more than `max_step`."""
    mean = np.empty_like(offset)
    for y, x in np.ndindex(offset.shape):
        rows, columns = (slice(max(k - radius, 0), k + radius + 1) for k in (y, x))
        differences = [int(other) - int(offset[y, x]) for other in offset[rows, columns].flat]
        near = [difference for difference in differences if abs(difference) <= max_step]
        # Exact: towards zero, that is, towards the middle's own.
        share = abs(sum(near)) // len(near)
        mean[y, x] = int(offset[y, x]) + (share if sum(near) > 0 else -share)
    return mean


def upsample_offsets(offset, max_step, shape):
    """Offsets (H, W) int32 at the pixels of the next finer level: interpolated where nine differ by little."""
    fine = np.empty(shape, dtype=np.int32)
    for y, x in np.ndindex(shape):
        row, column = y // 2, x // 2
        around = offset[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].astype(np.int64)
        fine[y, x] = offset[row, column]
        if around.max() - around.min() <= max_step:
            # A quarter of a coarser pixel from its middle: three quarters of it, one of the next on this side.
            rows, columns = (
                (own, min(max(own + 2 * (place % 2) - 1, 0), size - 1))
                for own, place, size in zip((row, column), (y, x), offset.shape, strict=True)
            )
            weights = [[9, 3], [3, 1]]
            total = sum(
                weights[j][i] * int(offset[r, c]) for j, r in enumerate(rows) for i, c in enumerate(columns)
            )
            fine[y, x] = (total + 8) // 16
    return fine


def search_windows(least, most, predicted, depth, clearance, own_clearance):
    """First residuals (H, W) int32 to search; the window is moved by what sticks out of it, in 1/256 pixel."""
    base = np.empty_like(predicted)
    for y, x in np.ndindex(predicted.shape):
        lowest, highest = (
            min(max(float(values[y // 2, x // 2]) * 512, -(2**29)), 2**29) for values in (least, most)
        )
        room = 256 * (depth // 2 - clearance)
        above = max(int(highest) - int(predicted[y, x]) - room, 0)
        below = max(int(predicted[y, x]) - int(lowest) - room, 0)
        shift = above - below
        if above and below:
            shift = abs(shift) // 2 * (1 if shift > 0 else -1)
        limit = 256 * (depth // 2 - own_clearance)
        base[y, x] = _nearest_256(min(max(shift, -limit), limit)) - depth // 2
    return base


def seed_planes(seeds, neighbours, alike, stiffness, unknown_stiffness, cell, shape):
    """Values at the centres of cells, by planes through the seeds (column, row, value) around each."""
    values = np.empty(shape)
    for y, x in np.ndindex(shape):
        beside = seeds[:, :2] - ((np.array([x, y]) + 0.5) * cell - 0.5)
        distance = np.hypot(*beside.T)
        near = np.argsort(distance, kind="stable")[:neighbours]
        weight = 1 / (distance[near] ** 2 + alike**2)
        terms = np.column_stack([np.ones(len(near)), beside[near]])
        ridge = weight.sum() * (stiffness * alike**2 + unknown_stiffness * distance[near[0]] ** 2)
        equations = terms.T @ (weight[:, None] * terms) + np.diag([0, ridge, ridge])
        values[y, x] = np.linalg.solve(equations, terms.T @ (weight * seeds[near, 2]))[0]
    return values


def _nearest_256(value):
    return (value + 128) // 256


def _offset_plane(differences, inside):
    """Value at the centre and gradient (x, y), 1/65536 pixel, of a least-squares plane; None if there is none.

    `differences` (5, 5) are offsets minus the centre's, `inside` says which of them count.
    """
    y, x = (index - 2 for index in np.nonzero(inside))
    o = differences[inside]
    n, sx, sy, sxx, sxy, syy = len(x), x.sum(), y.sum(), (x * x).sum(), (x * y).sum(), (y * y).sum()
    normal = [[n, sx, sy], [sx, sxx, sxy], [sy, sxy, syy]]
    right_side = [int(o.sum()), int((x * o).sum()), int((y * o).sum())]

    def cofactor(row, column):
        rows, columns = [k for k in range(3) if k != row], [k for k in range(3) if k != column]
        a, b, c, d = (int(normal[r][c]) for r in rows for c in columns)
        return (-1) ** (row + column) * (a * d - b * c)

    determinant = sum(int(normal[0][k]) * cofactor(0, k) for k in range(3))
    if n < 6 or determinant <= 0:
        return None
    solution = [sum(cofactor(r, k) * right_side[k] for k in range(3)) * (256.0 / determinant) for r in range(3)]
    return None if max(map(abs, solution)) >= 256 * 512 * 5 else [int(np.trunc(value)) for value in solution]


def _costs_around(offset, reference, target, y, x):
    """Costs of the five target pixels around a pixel's offset; None where not all of them have content."""
    given = int(offset[y, x])
    if abs(given) > 1 << 24:
        return None
    columns = x + _nearest_256(given) + np.arange(-2, 3)
    if columns[0] < 0 or columns[-1] >= target.shape[1]:
        return None
    words = [int(word) for word in target[y, columns]]
    return None if max(words) >= CENSUS_INVALID else [(w ^ int(reference[y, x])).bit_count() for w in words]


def fit_offsets(offset, reference, target):
    """Offsets (H, W) int32 in 1/256 pixel, refined by the V of the raw costs in a 5 x 5 window along its plane."""
    height, width = offset.shape
    ring = np.maximum(*np.abs(np.mgrid[-2:3, -2:3]))
    refined = offset.copy()
    costs = {pixel: _costs_around(offset, reference, target, *pixel) for pixel in np.ndindex(offset.shape)}
    for y, x in np.ndindex(offset.shape):
        centre = int(offset[y, x])
        if costs[y, x] is None:
            continue
        window = [(y + j, x + i) for j in range(-2, 3) for i in range(-2, 3)]
        there = np.array([0 <= r < height and 0 <= c < width and costs[r, c] is not None for r, c in window])
        difference = np.array([int(offset[q]) - centre if t else 0 for q, t in zip(window, there, strict=True)])
        there, difference = there.reshape(5, 5), difference.reshape(5, 5)
        plane = _offset_plane(difference, there & (np.abs(difference) <= 512 * ring))
        if plane is None:
            continue
        sums = np.zeros(3, dtype=int)
        rounded = 0
        count = 0
        for j, i in np.argwhere(there):
            predicted = _nearest_256(plane[0] + plane[1] * (int(i) - 2) + plane[2] * (int(j) - 2))
            whole = _nearest_256(predicted + centre)
            step = whole - _nearest_256(int(difference[j, i]) + centre)
            if abs(int(difference[j, i]) - predicted) > 512 or abs(step) > 1:
                continue
            sums += costs[y + j - 2, x + i - 2][step + 1 : step + 4]
            rounded += predicted + centre - whole * 256
            count += 1
        rise = max(sums[0], sums[2]) - sums[1]
        if count < 6 or rise <= 0 or sums[1] > min(sums):
            continue
        tip = 0 if sums[1] == 0 else int(np.trunc(int(sums[0] - sums[2]) * 128 / int(rise)))
        change = _nearest_256(plane[0]) + tip - int(np.trunc(rounded / count))
        if abs(change) <= 256:
            refined[y, x] = centre + change
    return refined


def transfer_disparity(left, max_step, right_width):
    """Disparity map of the right image's columns: the nearest of the surfaces that meet a column."""
    right = np.full((left.shape[0], right_width), np.nan)
    for y, row in enumerate(left.astype(float)):
        claims: dict = {}  # right column: disparities
        for x, d in enumerate(row):
            if np.isnan(d):
                continue
            before = row[x - 1] if x > 0 else np.nan
            beside = row[x + 1] if x + 1 < len(row) else np.nan
            nearest = int(np.rint(x - d))
            to_left, to_right = (abs(other - d) <= max_step for other in (before, beside))
            if not (to_right and nearest >= x - d) and not (to_left and nearest <= x - d):
                claims.setdefault(nearest, []).append(d)
            if not to_right:
                continue
            start, end = x - d, x + 1 - beside
            if end > start:
                for r in range(int(np.ceil(start)), int(np.floor(end)) + 1):
                    claims.setdefault(r, []).append(d + (r - start) * (beside - d) / (end - start))
        for r, disparities in claims.items():
            if 0 <= r < right_width:
                right[y, r] = max(disparities)
    return right


def vote_depth(depths, sigmas, tolerance, stations):
    """Depth, sigma, support, and the least distance of any pair of candidates from the gate, per pixel.

    Candidates of one station count as one, with the mean of their weights and weighted depths.
    """
    stations = np.asarray(stations)
    shape = depths.shape[1:]
    depth, sigma = np.zeros(shape), np.zeros(shape)
    support, clearance = np.zeros(shape, dtype=int), np.full(shape, np.inf)
    for pixel in np.ndindex(shape):
        index = (slice(None), *pixel)
        found = depths[index] > 0
        z, variance = depths[index][found].astype(float), sigmas[index][found].astype(float) ** 2
        if not len(z):
            continue
        gate = tolerance * np.sqrt(variance[:, None] + variance)
        difference = np.abs(z[:, None] - z)
        clearance[pixel] = np.abs(difference / gate - 1).min()
        agree = difference <= gate
        at = stations[found]
        # Most friends first, then the smallest variance, then the first.
        centre = min(range(len(z)), key=lambda k: (-len(set(at[agree[k]])), variance[k], k))
        members = [agree[centre] & (at == station) for station in sorted(set(at[agree[centre]]))]
        weights = [np.mean(1 / variance[own]) for own in members]
        weighted = [np.mean(z[own] / variance[own]) for own in members]
        depth[pixel] = sum(weighted) / sum(weights)
        sigma[pixel] = sum(weights) ** -0.5
        support[pixel] = len(members)
    return depth, sigma, support, clearance


def _read_depth(depth, u, v):
    """Inverse-depth bilinear value of one surface, else the nearest pixel's; 0 = none."""
    height, width = depth.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0
    nearest = depth[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))]
    x, y = int(u), int(v)
    if x + 1 >= width or y + 1 >= height or not nearest > 0:
        return nearest
    corners = depth[y : y + 2, x : x + 2]
    if (np.abs(corners - nearest) > 0.02 * nearest).any():
        return nearest
    weights = np.outer([1 - (v - y), v - y], [1 - (u - x), u - x])
    return 1 / (weights / corners).sum()


def compare_depths(view, depth, sigma, partner, maps, max_error, tolerance, min_support, *, silence_counts):
    """Verdict (+1 agrees, -1 looks through, 0 none), whether the partner has a depth there (or, if silence
    counts, the point in view) that does not hide the point, the partner's depth, its sigma of inverse depth,
    clearance.

    `maps` are the partner's depth, sigma and support.
    `view` and `partner` have K, R, t; pixel (row, col) stands for the image coordinates (col, row), COLMAP's
    origin of depth maps. The clearance is the least relative distance from any gate or from a pixel's border.
    """
    partner_depth, partner_sigma, partner_support = maps
    shape = depth.shape
    verdict, clearance = np.zeros(shape, dtype=int), np.full(shape, np.inf)
    carried, spread, observing = np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=bool)
    for row, col in np.ndindex(shape):
        z = float(depth[row, col])
        if not z > 0:
            continue
        world = view.R.T @ (np.linalg.solve(view.K, [col, row, 1.0]) * z - view.t)
        seen = partner.R @ world + partner.t
        pixel = partner.K @ seen
        if not seen[2] > 0:
            continue
        u, v = pixel[:2] / pixel[2]
        border = np.subtract(partner_depth.shape[::-1], 1)
        clearance[row, col] = np.abs([u, v, *(border - (u, v))]).min()
        found = _read_depth(partner_depth.astype(float), u, v)
        if not found > 0:
            is_in_view = 0 <= u <= border[0] and 0 <= v <= border[1]
            observing[row, col] = silence_counts and is_in_view
            if is_in_view:  # another pixel may have a depth
                clearance[row, col] = min(clearance[row, col], abs(u % 1 - 0.5), abs(v % 1 - 0.5))
            continue
        nearest = int(np.floor(v + 0.5)), int(np.floor(u + 0.5))
        spread[row, col] = float(partner_sigma[nearest])
        back = partner.R.T @ (np.linalg.solve(partner.K, [u, v, 1.0]) * found - partner.t)
        back = view.R @ back + view.t
        home = view.K @ back
        error = np.hypot(home[0] / home[2] - col, home[1] / home[2] - row)
        gate = tolerance * np.hypot(spread[row, col], float(sigma[row, col]))
        difference = found - seen[2]
        carried[row, col] = back[2]
        if back[2] > 0 and error <= max_error and abs(difference) <= gate:
            verdict[row, col] = 1
        elif difference > 2 * gate and partner_support[nearest] >= min_support:
            verdict[row, col] = -1
        spread[row, col] *= (seen[2] / found / z) ** 2
        observing[row, col] = difference >= -2 * gate
        clearance[row, col] = min(
            clearance[row, col],
            abs(error / max_error - 1),
            abs(abs(difference) / gate - 1),
            abs(abs(difference) / (2 * gate) - 1),
            abs(u % 1 - 0.5),
            abs(v % 1 - 0.5),
        )
    return verdict, observing, carried, spread, clearance


def pixel_area(view, pixels, depth, normals):
    """Areas of tangent planes that pixels (n, 2) (col, row) cover: differences of where their rays meet these."""
    inverse = np.linalg.inv(view.K)
    step = 1e-3

    def rays(moved):
        return np.column_stack([pixels + moved, np.ones(len(pixels))]) @ inverse.T

    points = depth[:, None] * rays((0, 0))

    def meet(moved):
        ray = rays(moved)
        return ray * ((normals * points).sum(axis=1) / (normals * ray).sum(axis=1))[:, None]

    across = meet((step, 0)) - meet((-step, 0))
    down = meet((0, step)) - meet((0, -step))
    return np.linalg.norm(np.cross(across, down), axis=1) / (2 * step) ** 2


def _agreement(world, normals, partner, options):
    """What a partner says of world points (n, 3): pixels (n, 2) (col, row), whether these have a depth, distances
    from them, whether depth and normal agree; clearances.
    """
    view = partner.view
    seen = world @ view.R.T + view.t
    before = seen[:, 2] > 0
    image = seen @ view.K.T
    place = image[:, :2] / np.where(before, image[:, 2], 1)[:, None]
    clearance = np.where(before, np.abs(place % 1 - 0.5).min(axis=1), np.inf)
    inside = before & (place >= -0.5).all(axis=1) & (place < np.array(partner.depth.shape[::-1]) - 0.5).all(axis=1)
    pixels = np.where(inside[:, None], np.floor(place + 0.5), 0).astype(int)
    x, y = pixels.T
    depth = partner.depth[y, x].astype(float)
    has_depth = inside & (depth > 0)
    difference = np.abs(depth - seen[:, 2]) / np.where(has_depth, depth, 1) / options.max_depth_error
    cosine = ((normals @ view.R.T) * partner.normals[:, y, x].T.astype(float)).sum(axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / options.max_normal_error
    gates = np.minimum(np.abs(difference - 1), np.abs(angle - 1))
    clearance = np.where(has_depth, np.minimum(clearance, gates), clearance)
    distance = np.hypot(*(place - pixels).T)
    return pixels, has_depth, distance, has_depth & (difference <= 1), has_depth & (angle <= 1), clearance


def gate(world, normals, partner, options):
    """What keeps a partner from agreeing with world points (n, 3): 0 unseen, 1 depth, 2 normal, 3 nothing; the
    distances from its pixels' centres, 0 where unseen; clearances.
    """
    _, has_depth, distance, same_depth, same_normal, clearance = _agreement(world, normals, partner, options)
    return has_depth * (1 + same_depth * (1 + same_normal)), has_depth * distance, clearance


def fuse_view(reference, partners, options, stations):
    """Points of a view by pixel (col, row): position, normal, colour, views; and the clearance of each pixel.

    `reference` and `partners` are `fusion.ViewMaps`; `stations` numbers those of the partners, 0 is its own.
    The clearance is the least relative distance from any gate, from a pixel's border and between two areas.
    """
    view = reference.view
    rows, columns = np.nonzero(reference.depth > 0)
    pixels = np.column_stack([columns, rows])
    z = reference.depth[rows, columns].astype(float)
    own = reference.normals[:, rows, columns].T.astype(float)
    rays = np.linalg.solve(view.K, np.column_stack([pixels, np.ones(len(z))]).T).T
    world = (rays * z[:, None] - view.t) @ view.R
    normals = own @ view.R
    area = pixel_area(view, pixels, z, own)
    least = np.full(len(z), np.inf)
    covered = np.zeros(len(z), bool)
    views = [[reference.index] for _ in z]
    seen_from = [{0} for _ in z]
    colours = [[colour] for colour in reference.image[rows, columns].astype(int)]
    for partner, station in zip(partners, stations, strict=True):
        places, _, distance, same_depth, same_normal, margin = _agreement(world, normals, partner, options)
        least = np.minimum(least, margin)
        agrees = np.nonzero(same_depth & same_normal)[0]
        x, y = places[agrees].T
        other = pixel_area(partner.view, places[agrees], partner.depth[y, x], partner.normals[:, y, x].T)
        margin = np.minimum(
            np.abs(distance[agrees] / options.reprojection_error - 1), np.abs(other / area[agrees] - 1)
        )
        least[agrees] = np.minimum(least[agrees], margin)
        covered[agrees] |= (distance[agrees] <= options.reprojection_error) & (other < area[agrees])
        for k, colour in zip(agrees.tolist(), partner.image[y, x].astype(int), strict=True):
            views[k].append(partner.index)
            seen_from[k].add(station)
            colours[k].append(colour)
    points = {}
    for k, pixel in enumerate(pixels.tolist()):
        if not covered[k] and len(seen_from[k]) >= options.min_num_pixels:
            rgb = np.floor(np.mean(colours[k], axis=0) + 0.5)[::-1]
            points[tuple(pixel)] = (world[k], normals[k], rgb, tuple(views[k]))
    clearance = np.full(reference.depth.shape, np.inf)
    clearance[rows, columns] = least
    return points, clearance


def _bilinear(image, u, v):
    x, y = int(np.floor(u)), int(np.floor(v))
    (a, b), (c, d) = image[y : y + 2, x : x + 2].astype(float)
    return (1 - (v - y)) * (a + (u - x) * (b - a)) + (v - y) * (c + (u - x) * (d - c))


def patch_equations(image, source, matrix, planes, contrast, min_score):
    """Equations (12, H, W) float64 of matching small planes in one source; see `depth.h` for their order.

    Every tap goes through the whole projection, not through an affine map at the window's middle, and the
    derivatives are differences of sampled windows. NaN where a window is too near to the source's rim to say.
    """
    height, width = image.shape
    equations = np.zeros((12, height, width))
    taps = [(i - 2.5, j - 2.5) for j in range(6) for i in range(6)]
    by = np.array([(1, dx, dy) for dx, dy in taps])
    for row, column in np.ndindex(image.shape):
        plane = planes[:, row, column].astype(float)
        if not (plane[0] > 0 and 3 <= row <= height - 3 and 3 <= column <= width - 3):
            continue

        def place(inverse, dx, dy, row=row, column=column):
            x, y, z = matrix @ [column + dx, row + dy, 1.0, inverse]
            return np.array([x / z, y / z]) - 0.5

        places = np.array([place(plane @ change, *tap) for tap, change in zip(taps, by, strict=True)])
        rim = np.array([places.min(), *(np.array(source.shape[::-1]) - (1, 2) - places.max(axis=0))]).min()
        if rim < 0.2:
            equations[:, row, column] = 0 if rim < -0.2 else np.nan
            continue
        r = np.array([image[int(row + dy - 0.5), int(column + dx - 0.5)] for dx, dy in taps], float)
        s = np.array([_bilinear(source, *p) for p in places])
        middle = image[row - 1 : row + 1, column - 1 : column + 1].mean()
        w = np.array([np.exp(-(dx * dx + dy * dy) / 18) for dx, dy in taps]) / (1 + ((r - middle) / contrast) ** 2)
        # Per inverse depth: the parallax at the middle, times the slope of the source, constant within its pixel.
        step = 1e-6 * plane[0]
        parallax = (place(plane[0] + step, 0, 0) - place(plane[0] - step, 0, 0)) / (2 * step)
        tiny = 1e-7
        slope = [
            [
                (_bilinear(source, *(np.floor(p) + f + tiny * e)) - _bilinear(source, *(np.floor(p) + f))) / tiny
                for e in np.eye(2)
            ]
            for p, f in ((p, np.clip(p - np.floor(p), 0, 1 - 2 * tiny)) for p in places)
        ]
        g = (np.array(slope) @ parallax)[:, None] * by

        def mean(values, w=w):
            return np.average(values, axis=0, weights=w)

        r_unit = (r - mean(r)) / np.sqrt(mean(r * r) - mean(r) ** 2 + 4)
        scale = 1 / np.sqrt(mean(s * s) - mean(s) ** 2 + 4)
        s_unit = (s - mean(s)) * scale
        score = mean(r_unit * s_unit)
        if abs(score - min_score) < 1e-3:
            equations[:, row, column] = np.nan
        if score <= min_score:
            continue
        # What a change of the plane does to the normalised window: without its part along the window itself.
        change = (g - mean(g)) * scale
        along = mean(s_unit[:, None] * change)
        matrix_of = mean(change[:, :, None] * change[:, None]) - np.outer(along, along)
        right = mean(r_unit[:, None] * change) - score * along
        upper = matrix_of[np.triu_indices(3)]
        equations[:, row, column] += w.sum() * np.array([1, 2 * (1 - score), parallax @ parallax, *right, *upper])
    return equations


def draw_heights(depth, normals, ray_from_pixel, cells_from_camera, shift, half, max_ratio, shape):
    """Heights of pixels' patches: for every cell, every triangle that its centre lies in."""
    heights = np.full(shape, -np.inf)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    for y, x in np.argwhere(depth > 0):
        normal = normals[:, y, x].astype(np.float64)
        facing = normal @ ray_from_pixel @ [x, y, 1]
        corners = []
        for right, down in ((-half, -half), (half, -half), (half, half), (-half, half)):
            ray = ray_from_pixel @ [x + right, y + down, 1]
            ratio = facing / (normal @ ray)
            corners.append((ratio, cells_from_camera @ (ray * depth[y, x] * ratio) + shift))
        if facing >= 0 or not all(1 / max_ratio < ratio < max_ratio for ratio, _ in corners):
            continue
        for chosen in ((0, 1, 2), (0, 2, 3)):
            triangle = np.array([corners[k][1] for k in chosen])
            inverse = np.linalg.inv(np.vstack([triangle[:, :2].T, np.ones(3)]))
            shares = np.tensordot(inverse, np.stack([columns, rows, np.ones_like(rows)]), 1)
            inside = (shares >= 0).all(axis=0)
            value = np.tensordot(triangle[:, 2], shares, 1)
            heights[inside] = np.maximum(heights, value)[inside]
    return heights
