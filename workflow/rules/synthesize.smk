rule synthesize:
    input:
        features=look_file("features/{sample}.features.npz"),
        surface=look_file("surfaces/{surface}.surface.npz"),
    output:
        map=at("maps/{look}.map.npz"),
        summary=at("summaries/synthesize/{look}.json"),
    log:
        at("logs/synthesize/{look}.log"),
    benchmark:
        at("benchmarks/synthesize/{look}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(3000),
        memory=MEMORY,
    params:
        k=of_look("k"),
        turn=of_look("turn_deg"),
        scale=lambda wildcards: option(
            "--texels-per-unit", LOOKS[wildcards.look].get("texels_per_unit")
        ),
        levels=lookup("textons/levels", within=config),
        seed=lookup("seed", within=config),
        code=code("synthesis", "surface", "analysis", "cli/synthesize.py"),
    message:
        "growing {wildcards.look}"
    shell:
        "btfpipe synthesize {input.features:q} {input.surface:q} -k {params.k}"
        " --levels {params.levels}"
        " --turn-deg {params.turn} {params.scale} --seed {params.seed} --threads {threads} {resources.memory}"
        " --out {output.map:q} --json > {output.summary:q} 2> {log:q}"
