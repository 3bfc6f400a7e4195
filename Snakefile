# Table of contents of the pipeline: one rule file a stage.
#
#   snakemake --cores all --configfile config/sample.yaml
#
# What to make is said in the config file (config/README.md explains every key).

from snakemake.utils import min_version

min_version("9.12")


# --configfile merges into what stands here, so a run of one's own must not find the sample's materials in it.
if not config:

    configfile: "config/sample.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/compress.smk"
include: "workflow/rules/textons.smk"
include: "workflow/rules/surface.smk"
include: "workflow/rules/synthesize.smk"
include: "workflow/rules/render.smk"
include: "workflow/rules/compare.smk"
include: "workflow/rules/formats.smk"


rule all:
    default_target: True
    input:
        all_pictures(),
        all_fidelity(),
        all_exports(),
