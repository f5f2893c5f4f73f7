"""Does single pieces of work of one version of the package, whichever is on the path, and prints their seconds.

`before.py` runs this file's text with `python -c`, once for each version. It speaks to both, so it uses nothing that
only one of them has. A line on standard input names a piece of work; the answer is a line of JSON.
"""

import copy
import dataclasses
import gc
import json
import math
import os
import sys
import time
from pathlib import Path

# The answers are all that is on standard output; lines of the methods and of nerfstudio go nowhere.
answers = os.fdopen(os.dup(1), "w")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

import torch  # noqa: E402
from nerfstudio.engine.callbacks import TrainingCallbackLocation  # noqa: E402

from sparsestyle_ns.data.llff import LLFFDataParserConfig  # noqa: E402
from sparsestyle_ns.engine.training import Training, warm_start  # noqa: E402
from sparsestyle_ns.method_configs import method_config  # noqa: E402
from sparsestyle_ns.utils.machine import synchronize  # noqa: E402


class Work:
    """The pieces of work on one scene at one size; what they need is made when it is first asked for."""

    def __init__(self, task):
        self.task, self.device = task, torch.device(task["device"])
        self.known = torch.load(task["coarse_state"], map_location="cpu")
        self._coarse = self._style = None

    def config(self, method):
        """A method's config with its defaults, on the scene at the size."""
        config = copy.deepcopy(method_config(method))
        manager = config.pipeline.datamanager
        manager.data, manager.dataparser = Path(self.task["scene"]), LLFFDataParserConfig()
        manager.max_image_side, manager.camera_res_scale_factor = self.task["side"], math.inf
        for name, value in self.known["coarse_field"].items():
            setattr(config.pipeline.model.coarse_field, name, value)
        if self.task["quick"] and method == "coarse-fewshot":
            manager.train_num_rays_per_batch = 32
        return config

    def coarse(self):
        """Stage 1, from its beginning."""
        if self._coarse is None:
            self._coarse = Training(self.config("coarse-fewshot"), self.device)
        return self._coarse

    def style(self):
        """Stage 2 on the coarse field that is there, before its first iteration; without warm start."""
        if self._style is None:
            config = self.config("hier-style")
            pipeline = config.pipeline
            pipeline.style_image, pipeline.backbone = Path(self.task["style_image"]), self.task["backbone"]
            pipeline.model.fine_encoding, pipeline.warm_start_steps = "hash", 0
            names = {field.name for field in dataclasses.fields(pipeline)}
            if "view_scales" in names:  # all at the photos' size
                pipeline.view_scales = pipeline.scale_shares = (1.0,)
            if "view_side" in names:
                pipeline.view_side = "photos"
            if self.task["quick"]:
                pipeline.model.log2_table_size, pipeline.model.occupancy_resolution = 12, 16
                pipeline.feature_side = 64
            self._style = Training(config, self.device, self.known["state"])
        return self._style

    def camera(self, training):
        """A view that wasn't trained on."""
        return training.pipeline.datamanager.eval_dataset.cameras[:1].to(self.device)

    def coarse_step(self):
        """An iteration of stage 1."""
        return self.coarse().step

    def style_step(self):
        """An iteration of stage 2."""
        return self.style().step

    def warm_start_step(self):
        """A step of the warm start of stage 2."""
        training = self.style()

        def work():
            training.pipeline.config.warm_start_steps = 1
            for _ in warm_start(training.pipeline, training.pipeline.task, training.optimizers):
                pass

        training.pipeline.train()
        return work

    def coarse_view(self):
        """A picture of the coarse field that is there, by stage 1's model, which doesn't learn any more."""
        training = self.coarse()
        model = training.pipeline.model
        # The grid that guides samples in training may be there in one version or run and not in the other.
        missing = model.load_state_dict(self.known["state"], strict=False).missing_keys
        assert not any(name.startswith("field.") for name in missing), missing
        for callback in training.callbacks:
            callback.run_callback_at_location(0, TrainingCallbackLocation.AFTER_TRAIN)
        training.pipeline.eval()
        camera = self.camera(training)
        return lambda: model.get_outputs_for_camera(camera)

    def style_view(self):
        """An exact stylised picture."""
        training = self.style()
        training.pipeline.eval()
        camera = self.camera(training)
        return lambda: training.pipeline.model.get_outputs_for_camera(camera)

    def facts(self):
        """What the comparison says of the version."""
        coarse, style = method_config("coarse-fewshot"), method_config("hier-style")
        cameras = self.coarse().pipeline.datamanager.train_dataset.cameras
        return {
            "coarse_iterations": coarse.max_num_iterations,
            "style_iterations": style.max_num_iterations,
            "warm_start_steps": style.pipeline.warm_start_steps,
            "size": [int(cameras.width[0]), int(cameras.height[0])],
        }


def main():
    """Answers line by line until standard input ends."""
    task = json.loads(sys.argv[1])
    torch.set_num_threads(task["threads"])
    torch.manual_seed(0)
    work, prepared = Work(task), {}
    for line in sys.stdin:
        name = line.strip()
        if name == "facts":
            answer = work.facts()
        else:
            if name not in prepared:
                prepared[name] = getattr(work, name)()
            gc.collect()
            synchronize(work.device)
            start = time.perf_counter()
            prepared[name]()
            synchronize(work.device)
            answer = {"seconds": time.perf_counter() - start}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
