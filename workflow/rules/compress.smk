rule compress:
    input:
        sample=at("samples/{sample}.sample.npz"),
    output:
        model=at("models/{sample}.model.npz"),
        summary=at("summaries/compress/{sample}.json"),
    log:
        at("logs/compress/{sample}.log"),
    benchmark:
        at("benchmarks/compress/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 2
    resources:
        mem_mb=mem_mb(3000),
        memory=MEMORY,
    params:
        options=" ".join(
            option(f"--{key}", config["compress"].get(key))
            for key in ("method", "ratio", "components")
        ),
        seed=lookup("seed", within=config),
        code=code("compression", "cli/compress.py"),
    message:
        "compressing {wildcards.sample}"
    shell:
        "btfpipe compress {input.sample:q} {params.options}"
        " --seed {params.seed} --threads {threads} {resources.memory}"
        " --out {output.model:q} --json > {output.summary:q} 2> {log:q}"
