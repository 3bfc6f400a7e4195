rule textons:
    input:
        model=at("models/{sample}.model.npz"),
    output:
        features=at("features/{sample}.features.npz"),
        summary=at("summaries/textons/{sample}.json"),
    log:
        at("logs/textons/{sample}.log"),
    benchmark:
        at("benchmarks/textons/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(3000),
        memory=MEMORY,
    params:
        textons=lookup("textons/textons", within=config),
        images=lookup("textons/images", within=config),
        levels=lookup("textons/levels", within=config),
        seed=lookup("seed", within=config),
        code=code("analysis", "compression", "cli/textons.py"),
    message:
        "extracting {params.textons} surface textons of {wildcards.sample}"
    shell:
        "btfpipe textons {input.model:q} --textons {params.textons} --images {params.images}"
        " --levels {params.levels} --seed {params.seed} --threads {threads} {resources.memory}"
        " --out {output.features:q} --json > {output.summary:q} 2> {log:q}"
