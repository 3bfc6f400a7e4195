"""Local PCA over clusters of texels, of one material or a database (Müller et al. 2007, section 5.2).

Texels whose values over all lights and views are alike form a cluster; each cluster has a mean and a few principal
vectors of its own. Materials measured under the same directions share the clusters. The steps are the paper's: each
sample is reduced by an SVD to 150 terms, the reduced texels of all samples are clustered together, and each cluster's
PCA is then that of the original pictures, read in blocks.
"""

import math
from types import SimpleNamespace

import numpy as np

from btfpipe import store
from btfpipe.compression.local_clusters import local_clusters
from btfpipe.compression.local_passes import (
    JOINT_TERMS,
    OVERSAMPLING,
    REDUCED_TERMS,
    TYPES,
    Passes,
    plan,
)
from btfpipe.compression.model import Model, measured_error
from btfpipe.compression.svd import factorise
from btfpipe.errors import InputError, naming
from btfpipe.parallel import blocks, single_threaded_blas
from btfpipe.sample.appearance import ShadingNeeds, svd_levels
from btfpipe.sample.resample import Resampled

# Of the pictures' 3 bytes a texel and pair, by default one in so many is spent: with 8 components in half precision
# this gives 16 clusters to a sample of 128 x 128 texels and 81 x 81 directions, and 250 to fifteen with 151 x 151,
# the numbers of the paper.
DEFAULT_RATIO = 54
_DIRECTIONS = ("light_directions", "view_directions", "light_index", "view_index")
# The facts of a material, with their forms; those of `_FACTS` are a Model's own.
_FORMS = {
    "name": "text",
    "shape": "shape",
    "toroidal": "flag",
    "texels_per_mm": "positive",
    "absolute": "flag",
}
_FACTS = ("toroidal", "texels_per_mm", "absolute")


class LocalPcaModel(Model):
    """One or several materials as clusters of texels, each with a mean and principal vectors over all pairs.

    ``value[texel, pair] = basis[label[texel], pair, 0] + sum_k coordinate[texel, k] * basis[label[texel], pair, k]``

    The Model evaluates one of its materials; `material` gives the others, which share its memory.

    Parameters
    ----------
    bases : (clusters, pairs, 3, 1 + terms) float16, float32 or int8
        The mean of the cluster, then its principal vectors.
    coordinates : (texels of all materials, terms) float16 or float32
        At most 1 in magnitude, so that the bases are of the size of the values.
    labels : (texels of all materials,) unsigned int
        Cluster of each texel, material by material, row by row.
    materials : list of dict
        ``name``, ``shape``, ``toroidal``, ``texels_per_mm``, ``absolute`` of each; ``resampled_from`` if it was.
    source : Appearance
        Gives directions and index tables.
    about : dict, optional
        Facts for the file.
    chosen : int
        The material that is evaluated.
    scales : (clusters, pairs) float16, optional
        What bases in bytes are multiplied by.
    masks : (texels of all materials,) bool, optional
        Valid texels, as `labels`; all by default.
    """

    method = "local-pca"

    def __init__(
        self, bases, coordinates, labels, materials, source, about=None, chosen=0, scales=None, masks=None
    ):  # fmt: skip
        facts = {name: materials[chosen][name] for name in _FACTS}
        tables = {name: getattr(source, name) for name in _DIRECTIONS}
        super().__init__(materials[chosen]["shape"], SimpleNamespace(**facts, **tables), about)
        self.bases = bases
        self.scales = scales
        self.coordinates = coordinates
        self.labels = labels
        self.about |= {"materials": materials, "material": chosen}
        self.masks = masks
        if masks is not None:
            self.mask = masks[self._range()].reshape(self.shape)

    @property
    def n_clusters(self):
        return len(self.bases)

    @property
    def n_terms(self):
        """Principal vectors a cluster, the mean left out."""
        return self.coordinates.shape[1]

    @property
    def materials(self):
        """Names of the materials."""
        return tuple(fact["name"] for fact in self.about["materials"])

    def material(self, which):
        """The same database, evaluating another of its materials.

        Parameters
        ----------
        which : int or str
            Index or name.

        Raises
        ------
        InputError
            If there is no such material.
        """
        names = self.materials
        index = names.index(which) if which in names else which
        if not isinstance(index, int | np.integer) or not 0 <= index < len(names):
            raise InputError(
                f"no material {which!r}; the database holds {len(names)}: {', '.join(names)}."
            )
        return type(self)(
            self.bases, self.coordinates, self.labels, self.about["materials"], self, self.about,
            int(index), self.scales, self.masks,
        )  # fmt: skip

    def arrays(self):
        """Of the whole database, whichever material is evaluated; so is `nbytes`."""
        arrays = {"bases": self.bases, "coordinates": self.coordinates, "labels": self.labels}
        optional = {"scales": self.scales, "mask": self.masks}
        return arrays | {name: array for name, array in optional.items() if array is not None}

    @classmethod
    def from_arrays(cls, reader, source):
        about = reader.about
        materials, chosen = about.get("materials"), about.get("material", 0)
        if (
            not isinstance(materials, list)
            or not all(isinstance(fact, dict) and set(_FORMS) <= set(fact) for fact in materials)
            or type(chosen) is not int
            or not 0 <= chosen < len(materials)
        ):
            raise InputError(
                f"{reader.path}: its description does not say which materials it holds."
            )
        for number, fact in enumerate(materials):
            for name, form in _FORMS.items():
                if name != "texels_per_mm" or fact[name] is not None:
                    store.check_fact(
                        fact[name], form, f"{reader.path}: {name} of material {number}"
                    )
        texels = sum(math.prod(fact["shape"]) for fact in materials)
        coordinates = reader.require("coordinates", (texels, None), "f")
        shape = (None, len(source.light_index), 3, 1 + coordinates.shape[1])
        bases = reader.require("bases", shape, "fi")
        scales = reader.require("scales", bases.shape[:2], "f") if "scales" in reader else None
        labels = reader.require("labels", (texels,), "u")
        if texels and labels.max() >= len(bases):
            raise InputError(
                f"{reader.path}: labels reach {labels.max()}; expected less than {len(bases)} clusters."
            )
        masks = reader.require("mask", labels.shape, "b") if "mask" in reader else None
        return cls(bases, coordinates, labels, materials, source, about, chosen, scales, masks)

    def _range(self):
        """Slice of the material's texels."""
        counts = [math.prod(fact["shape"]) for fact in self.about["materials"]]
        first = sum(counts[: self.about["material"]])
        return slice(first, first + counts[self.about["material"]])

    def own_texels(self):
        """Coordinates (texels, terms) float32 and labels (texels,) int32 of the material."""
        own = self._range()
        return np.asarray(self.coordinates[own], np.float32), np.asarray(self.labels[own], np.int32)

    def bases_of(self, index):
        """Bases float32 of an index into clusters, or into clusters and pairs."""
        bases = np.array(self.bases[index], np.float32, order="C")
        if self.scales is not None:
            bases *= np.asarray(self.scales[index], np.float32)[..., None, None]
        return bases

    def pictures(self, pairs):
        from btfpipe.compression.local_shading import fill_pictures

        coordinates, labels = self.own_texels()
        bases = self.bases_of((slice(None), pairs))
        out = np.empty((bases.shape[1], len(labels), 3), np.float32)
        fill_pictures(coordinates, labels, bases, out)
        return out.reshape(-1, *self.shape, 3)

    def texels(self, rows, cols):
        coordinates, labels = self.own_texels()
        index = np.ravel_multi_index(
            (np.asarray(rows) % self.shape[0], np.asarray(cols) % self.shape[1]), self.shape
        )
        coordinates, labels = coordinates[index], labels[index]
        out = np.empty((len(index), self.n_pairs, 3), np.float32)
        for cluster in np.unique(labels):
            own = np.flatnonzero(labels == cluster)
            basis = self.bases_of(cluster)
            out[own] = np.tensordot(coordinates[own], basis[..., 1:], (1, 2)) + basis[..., 0]
        return out

    @classmethod
    def shading_needs(cls, reader):
        bases = reader.require("bases", (None,) * 4, "fi", finite=False)
        coordinates = reader.require("coordinates", (None,) * 2, "f", finite=False)
        kept = 4 * (bases.size + coordinates.size + len(coordinates))
        return ShadingNeeds(kept, bases.size, **svd_levels(len(coordinates), bases.shape[1]))

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.local_shading import LocalPcaShader

        return LocalPcaShader(self, interpolation)


def compress_local_pca(
    samples,
    *,
    clusters=None,
    components=8,
    target_bytes=None,
    precision="half",
    names=None,
    resample=False,
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Cluster the texels of one or several Samples and give each cluster its own PCA.

    Parameters
    ----------
    samples : Appearance or sequence of Appearances
        Of the same directions and pairs unless `resample`; sizes may differ. Read in blocks of pictures, some six times.
    clusters : int, optional
        By default as many as `target_bytes` holds.
    components : int
        Principal vectors a cluster beside its mean, at least 1; no more are made than the largest cluster has.
    target_bytes : int, optional
        Size to stay within. A cluster takes ``3 * pairs * (1 + components)`` numbers (and a scale for each pair, in
        bytes), a texel `components` numbers and its cluster. By default a 54th of the pictures at 3 bytes a texel
        and pair: 16 clusters for one sample of 128 x 128 texels and 81 x 81 directions, in half precision.
    precision : str
        Of the numbers: ``half``, ``single``, or ``byte``: bases in bytes that are scaled for each cluster and pair,
        coordinates in half precision.
    names : sequence of str, optional
        Of the materials; by default ``material 0`` and so on.
    resample : bool
        Interpolate samples of other directions or pairs at those of the first, as they are read (see `Resampled`). The error
        of this interpolation comes on top of the Model's own and is not in its figures, which are measured against
        the resampled pictures; `compare` with the sample itself has both. Such samples are read two to five times as slowly.
    seed : int
        Of the random starts.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within; limits how many blocks are worked on at a time, never the result.
    on_progress : callable, optional
        Called with (pictures read, pictures to read).

    Returns
    -------
    LocalPcaModel
        Evaluates the first material. Its ``about`` holds `n_clusters`, `n_terms`, `precision`, `warnings` (sentences),
        `materials` (with `rmse` and `relative_error` of each, and `resampled_from`, the numbers of lights, views and
        pairs, of those that were), and over all materials `rmse` and `relative_error`,
        measured on the numbers as stored and over all linear values.

    Raises
    ------
    InputError
        Samples of different directions, more clusters than texels, a target too small for one cluster, no components,
        non-finite pictures, values beyond half precision, or too little memory.
    """
    samples = [samples] if hasattr(samples, "n_pairs") else list(samples)
    if not samples:
        raise InputError("no samples given; expected at least one.")
    names = [f"material {i}" for i in range(len(samples))] if names is None else list(names)
    if len(set(names)) != len(samples):
        raise InputError(
            f"{len(samples)} samples have {len(set(names))} different names; expected one each."
        )
    if precision not in TYPES:
        raise InputError(f"precision {precision!r}; expected half, single or byte.")
    if components < 1:
        raise InputError(f"{components} components asked for; expected at least 1.")
    resampled = _resample(samples, names, resample)
    pairs = samples[0].n_pairs
    clusters = _cluster_count(samples, clusters, components, target_bytes, precision)
    planned = plan(samples, clusters, components, precision, threads, memory)
    progress = _Progress(on_progress, pairs * (6 * len(samples) + 1))

    points = _reduced(samples, names, seed, threads, memory, progress)
    labels, directions, _ = local_clusters(
        points, clusters, components,
        given=components + OVERSAMPLING, seed=seed, threads=threads, on_progress=progress.part(pairs),
    )  # fmt: skip
    passes = Passes(samples, labels, clusters, precision, planned, progress)
    with single_threaded_blas():
        frames = passes.frames(points, directions)
        dimensions = points.shape[1]
        del points, directions
        frames = passes.improve(frames, components)
        bases, scales, coordinates = passes.project(frames, components)
    most = max(frame.shape[1] for frame in frames) - 1
    warnings = []
    if most < components:
        what = f"the clusters have at most {most} terms beside their mean"
        if most == dimensions >= REDUCED_TERMS:
            what = f"clusters are found in the texels' first {most} dimensions and get no more terms beside their mean"
        warnings.append(f"{what}: {components - most} of the {components} components left out")
        bases, coordinates = bases[..., : 1 + most].copy(), coordinates[:, :most].copy()
    materials = [
        {
            "name": name,
            "shape": [int(n) for n in sample.shape],
            "toroidal": bool(sample.toroidal),
            "texels_per_mm": sample.texels_per_mm,
            "absolute": bool(getattr(sample, "absolute", False)),
            **({"invalid_texels": sample.n_invalid} if sample.n_invalid else {}),
            **({"resampled_from": resampled[name]} if name in resampled else {}),
        }
        for name, sample in zip(names, samples, strict=True)
    ]
    labels = labels.astype(np.min_scalar_type(clusters - 1))
    masks = None
    if any(sample.n_invalid for sample in samples):
        full = (np.ones(s.shape, bool) if s.mask is None else s.mask for s in samples)
        masks = np.concatenate([mask.ravel() for mask in full])
    model = LocalPcaModel(
        bases, coordinates, labels, materials, samples[0], scales=scales, masks=masks
    )
    for index, (sample, facts) in enumerate(zip(samples, materials, strict=True)):
        facts |= measured_error(
            model.material(index), sample, threads=threads, on_progress=progress.part(pairs)
        )
    progress.finish()
    model.about |= {
        "n_clusters": clusters,
        "n_terms": model.n_terms,
        "precision": precision,
        **_overall(materials),
        "warnings": warnings,
    }
    return model


def _overall(materials):
    """RMSE and relative error over the values of all materials, from those of each."""
    squared, energy, count = 0.0, 0.0, 0
    for facts in materials:
        texels = math.prod(facts["shape"]) - facts.get("invalid_texels", 0)
        squared += facts["rmse"] ** 2 * texels
        if facts["relative_error"] > 0:
            energy += (facts["rmse"] / facts["relative_error"]) ** 2 * texels
        count += texels
    return {
        "rmse": math.sqrt(squared / count),
        "relative_error": math.sqrt(squared / energy) if energy > 0 else 0.0,
    }


def _resample(samples, names, allowed):
    """Put samples of other directions than the first in place at its directions, or refuse them by name.

    Returns
    -------
    dict
        By name of those samples, how many lights, views and pairs they have.
    """
    first, resampled = samples[0], {}
    for number, (sample, name) in enumerate(zip(samples, names, strict=True)):
        difference = _difference(first, sample, names[0])
        if difference is None:
            continue
        if not allowed:
            raise InputError(
                f"a database needs samples of equal directions; {name} has {difference}."
                " Compress them apart, or pass --resample."
            )
        with naming(name):
            samples[number] = Resampled(sample, first)
        resampled[name] = {
            "lights": len(sample.light_directions),
            "views": len(sample.view_directions),
            "pairs": sample.n_pairs,
        }
    return resampled


def _difference(first, sample, name):
    """What tells the directions and pairs of a sample from those of the first, which has the name; None: nothing."""
    for table in _DIRECTIONS:
        ours, theirs = getattr(first, table), getattr(sample, table)
        if len(ours) != len(theirs):
            return f"{len(theirs)} {_PLURALS[table]}, {name} has {len(ours)}"
        if table.endswith("index"):
            if (ours != theirs).any():
                return f"the same directions as {name}, but pairs them in another order"
            continue
        distance = np.abs(ours - theirs).max(axis=1)
        if distance.max() > 1e-6:
            at = int(distance.argmax())
            angle = math.degrees(math.acos(np.clip(np.dot(ours[at], theirs[at]), -1, 1)))
            return (
                f"other {_PLURALS[table]} than {name}: number {at} differs by {angle:.3g} degrees"
            )
    return None


_PLURALS = {
    "light_directions": "lights",
    "view_directions": "views",
    "light_index": "pairs",
    "view_index": "pairs",
}


def _cluster_count(samples, clusters, components, target_bytes, precision):
    """How many clusters, as asked for or as the bytes allow."""
    pairs = samples[0].n_pairs
    texels = sum(sample.shape[0] * sample.shape[1] for sample in samples)
    if clusters is not None:
        if target_bytes is not None:
            raise InputError("clusters and target bytes are both given; expected one of them.")
        if clusters < 1:
            raise InputError(f"{clusters} clusters asked for; expected at least 1.")
        if clusters > texels:
            raise InputError(f"{clusters} clusters for {texels} texels; expected at most {texels}.")
        return clusters
    first = samples[0]
    fixed = sum(getattr(first, table).nbytes for table in _DIRECTIONS[:2])
    basis, coordinate = (dtype.itemsize for dtype in TYPES[precision])
    fixed += texels * (components * coordinate + 1)
    each = pairs * (3 * (1 + components) * basis + (2 if precision == "byte" else 0))
    # more clusters than this have texels to themselves
    most = max(1, texels // (1 + components))
    if target_bytes is None:
        return min(max(1, (3 * pairs * texels // DEFAULT_RATIO - fixed) // each), most)
    count = (target_bytes - fixed) // each
    if count > 256:
        count = (target_bytes - fixed - texels) // each  # two bytes for a texel's cluster
    if count < 1:
        raise InputError(
            f"{target_bytes} bytes hold no cluster of {components} components; expected at least"
            f" {fixed + each}. Raise the target, or ask for fewer components."
        )
    return int(min(count, most))


class _Progress:
    """Reports stages of known weight, each with its own idea of a total, as one."""

    def __init__(self, on_progress, total):
        self.on_progress, self.total, self.before, self.last = on_progress, total, 0, 0

    def part(self, weight):
        """A callable for the next stage, which counts for `weight`."""
        start, self.before = self.before, min(self.before + weight, self.total)
        end = self.before

        def report(done, total):
            self._say(start + int((end - start) * min(done, total) / total))

        return report if self.on_progress is not None else None

    def finish(self):
        if self.on_progress is not None:
            self._say(self.total)

    def _say(self, done):
        self.last = max(self.last, done)
        self.on_progress(self.last, self.total)


def _reduced(samples, names, seed, threads, memory, progress):
    """Points (texels of all samples, dimensions) float32 whose distances are nearly those of the texels.

    Each sample is reduced to its first 150 singular vectors. Those of several samples are brought into one
    orthonormal frame, the principal one of what the samples have kept: with the right factors side by side,
    ``W = [V_1 S_1, V_2 S_2, ...]`` and ``W^T W = Z L Z^T``, sample m's coordinates in the frame ``W Z L^(-1/2)`` are
    ``U_m Z_m L^(1/2)``.
    """
    textures, angular = [], []
    for sample, name in zip(samples, names, strict=True):
        try:
            texture, weights, facts = factorise(
                sample, REDUCED_TERMS, measure=False, iterations=1, precision="single", seed=seed,
                threads=threads, memory=memory, on_progress=progress.part(3 * sample.n_pairs),
            )  # fmt: skip
        except InputError as error:
            raise InputError(f"{name}: {error}" if len(samples) > 1 else str(error)) from error
        root = np.sqrt(np.array(facts["singular_values"])).astype(np.float32)
        textures.append((texture, root))
        if len(samples) > 1:
            angular.append((weights.reshape(-1, len(root)), root))
    if len(samples) == 1:
        points = textures[0][0] * textures[0][1]
    else:
        ends = np.cumsum([0, *(len(root) for _, root in angular)])
        gram = np.zeros((ends[-1], ends[-1]))
        with single_threaded_blas():
            for part in blocks(3 * samples[0].n_pairs, 4096):
                some = np.concatenate([factors[part] * root for factors, root in angular], axis=1)
                gram += some.T @ some
            del angular
            values, turn = np.linalg.eigh(gram)
            kept = np.flatnonzero(values[::-1][:JOINT_TERMS] > 1e-9 * max(values[-1], 1e-300))
            values, turn = values[::-1][kept], turn[:, ::-1][:, kept]
            turn = turn * np.sqrt(values)
            parts = []
            for m, (texture, root) in enumerate(textures):
                inverse = np.where(root > 0, 1 / np.where(root > 0, root, 1), 0)
                parts.append((texture * inverse) @ turn[ends[m] : ends[m + 1]].astype(np.float32))
        points = np.concatenate(parts)
    points -= points.mean(axis=0, dtype=np.float64).astype(np.float32)
    return points
