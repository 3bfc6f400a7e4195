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
        mem_mb=3000,
    params:
        components=lookup("compress/components", within=config),
        seed=lookup("seed", within=config),
        code=code("compression", "cli/compress.py"),
    message:
        "compressing {wildcards.sample} to {params.components} terms"
    shell:
        "btfpipe compress {input.sample:q} --method svd --components {params.components}"
        " --seed {params.seed} --threads {threads}"
        " --out {output.model:q} --json > {output.summary:q} 2> {log:q}"
