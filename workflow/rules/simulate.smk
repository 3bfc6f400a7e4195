rule simulate_truth:
    input:
        spec=lambda wildcards: lookup(
            f"samples/{wildcards.sample}/truth/spec", within=config
        ),
        pairs=lambda wildcards: lookup(
            f"samples/{wildcards.sample}/truth/pairs", within=config
        ),
    output:
        stack=at("samples/{sample}.truth.zip"),
        summary=at("summaries/simulate/{sample}.json"),
    log:
        at("logs/simulate/{sample}.log"),
    benchmark:
        at("benchmarks/simulate/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(2000),
        memory=MEMORY,
    params:
        seed=lookup("seed", within=config),
        code=code("simulation", "cli/simulate.py"),
    message:
        "simulating {wildcards.sample} at directions that nobody measured"
    shell:
        "btfpipe simulate {input.spec:q} --directions {input.pairs:q} --format exr --seed {params.seed}"
        " --threads {threads} {resources.memory} --out {output.stack:q} --json > {output.summary:q} 2> {log:q}"
