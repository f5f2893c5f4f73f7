"""What nerfstudio's commands load to offer `llff-data`, while nerfstudio's own configs are still being imported.

So neither this module nor what it imports may import a datamanager, a pipeline or `TrainerConfig`.
"""

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from sparsestyle_ns.data.llff import LLFFDataParserConfig

llff = DataParserSpecification(
    config=LLFFDataParserConfig(),
    description="Forward-facing photos in an LLFF folder (poses_bounds.npy, images_8), for a scene in NDC.",
)
