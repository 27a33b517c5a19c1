"""Frames that rendered cameras take, and the tags that are found in them."""

import copy
from typing import Any

import numpy as np

from projservo_cli.records import CORNERS, ByteArray, FloatArray, InputError
from projservo_cli.simulation.mjcf import mujoco, no_gl
from projservo_cli.simulation.scene import CAMERAS, FINER, RenderedModel, drawn_at, lens_of

_STILL = 1e-5  # rad or m: what joints move less in an exposure blurs nothing


class Frames:
    """Both cameras of a scene, which a thread opens, looks with and closes.

    ``rendered``: their scene. ``last``: (2, height, width) the last frames of both.
    """

    borders = True

    def __init__(self, rendered: RenderedModel) -> None:
        scene = rendered.scene
        self.rendered, self._finder, self._scene = rendered, rendered.finder, scene
        self._places = {number: i for i, number in enumerate(scene.numbers)}
        width, height = scene.size
        self.last: ByteArray = np.zeros((2, height, width), dtype=np.uint8)
        self._maps = self._mapped(scene.P)
        self._renderer: Any = None

    def open(self) -> None:
        """Make ready to draw, in the thread that looks; an InputError says what to install for that."""
        mj, rendered = mujoco(), self.rendered
        height, width = self.last.shape[1] + 2 * rendered.margin, self.last.shape[2] + 2 * rendered.margin
        try:
            self._renderer = mj.Renderer(rendered.model, FINER * height, FINER * width)
        except Exception as error:  # of another kind for each library of GL
            raise InputError(no_gl(error)) from error
        self._renderer.scene.flags[mj.mjtRndFlag.mjRND_SHADOW] = self._scene.options.light == "side"
        self._renderer.scene.flags[mj.mjtRndFlag.mjRND_SKYBOX] = 0  # of a file: it takes longer than the rest
        self._model = copy.copy(rendered.model)
        self._data = rendered.begin(self._model, rendered.model.qpos0[rendered.positions])
        self._shown = mj.MjvOption()
        self._shown.sitegroup[:] = 0

    def close(self) -> None:
        """Let go of what draws."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def capture(
        self, view: int, q: FloatArray, moved: tuple[int, FloatArray] | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (m, 2) that are found in a frame, NaN where unseen, and their deviations (m,), px.

        q : (k, n) joints at instants of its exposure, rad or m.
        moved : number of a marker whose tag was moved, and by how much in the frame of the tool, (3,) m.
        """
        self._move(moved)
        still = np.abs(q - q[len(q) // 2]).max() < _STILL
        shots = [self._drawn(view, joints) for joints in (q[len(q) // 2 :][:1] if still else q)]
        image = np.mean(shots, axis=0, dtype=np.float32)
        cv = self._finder.cv
        if self._scene.options.blur_px > 0.0:
            image = cv.GaussianBlur(image, (0, 0), self._scene.options.blur_px)
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        image += np.float32(self._scene.options.grey_noise) * noise
        self.last[view] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return self._found(view)

    def _found(self, view: int) -> tuple[FloatArray, FloatArray]:
        """Pixels (m, 2) of the corners in the last frame of a view, NaN where unseen, and deviations (m,)."""
        pixels, sigma = np.full((len(self._places), 2), np.nan), np.full(len(self._places), np.nan)
        tags, _ = self._finder.find(self.last[view].astype(np.float64))
        for number, tag in tags.items():
            for k in range(CORNERS):
                if (place := self._places.get(CORNERS * number + k)) is not None:
                    pixels[place], sigma[place] = tag.pixels[k], tag.sigma[k]
        return pixels, sigma

    def _drawn(self, view: int, q: FloatArray) -> ByteArray:
        """Return the grey values (height, width) of a camera at joints (n,), without blur and noise."""
        mj = mujoco()
        self._data.qpos[self.rendered.positions] = q
        mj.mj_kinematics(self._model, self._data)
        mj.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, CAMERAS[view], self._shown)
        # Tags, their holder and light have no colour: green alone stands for grey.
        fine, cv = np.ascontiguousarray(self._renderer.render()[..., 1]), self._finder.cv
        if self._maps is not None:
            fine = cv.remap(fine, *self._maps[view], cv.INTER_LANCZOS4)
        return np.asarray(cv.resize(fine, self._scene.size, interpolation=cv.INTER_AREA))

    def _move(self, moved: tuple[int, FloatArray] | None) -> None:
        """Put every plate where it is, but for one that was moved."""
        self._model.geom_pos[:] = self.rendered.model.geom_pos
        if moved is not None:
            plate = self.rendered.plates[self._places[moved[0]] // CORNERS]
            self._model.geom_pos[list(plate)] += self.rendered.tool @ moved[1]

    def _mapped(self, P: FloatArray) -> list[tuple[FloatArray, FloatArray]] | None:
        """Return the places of finer pixels of a frame in the drawing, u and v of each view."""
        width, height = FINER * self._scene.size[0], FINER * self._scene.size[1]
        offset = 0.5 * (FINER - 1)  # centres of pixels have whole coordinates
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        pixels = (np.stack([u, v], axis=-1).reshape(-1, 2) - offset) / FINER
        lens = lens_of(P, self._scene.options.k1)
        drawn = drawn_at(P, lens, np.stack([pixels, pixels]))
        if np.array_equal(drawn[0], pixels) and np.array_equal(drawn[1], pixels):
            return None
        maps = (
            (FINER * (drawn + self.rendered.margin) + offset).reshape(2, height, width, 2).astype(np.float32)
        )
        return [(np.ascontiguousarray(both[..., 0]), np.ascontiguousarray(both[..., 1])) for both in maps]
