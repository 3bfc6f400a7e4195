rule surface:
    input:
        mesh=lambda wildcards: config["surfaces"][wildcards.surface]["mesh"],
        field=lambda wildcards: config["surfaces"][wildcards.surface].get("field", []),
    output:
        surface=at("surfaces/{surface}.surface.npz"),
        summary=at("summaries/surface/{surface}.json"),
    log:
        at("logs/surface/{surface}.log"),
    benchmark:
        at("benchmarks/surface/{surface}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(4000),
        memory=MEMORY,
    params:
        vertices=lambda wildcards: config["surfaces"][wildcards.surface]["vertices"],
        field=lambda wildcards, input: option("--field", input.field or None),
        crease=lambda wildcards: option(
            "--crease-deg", config["surfaces"][wildcards.surface].get("crease_deg")
        ),
        levels=lookup("textons/levels", within=config),
        seed=lookup("seed", within=config),
        code=code("surface", "cli/surface.py"),
    message:
        "resampling {wildcards.surface} to {params.vertices} vertices"
    shell:
        "btfpipe surface {input.mesh:q} --vertices {params.vertices} {params.field} {params.crease}"
        " --levels {params.levels} --seed {params.seed} --threads {threads} {resources.memory}"
        " --out {output.surface:q} --json > {output.summary:q} 2> {log:q}"
