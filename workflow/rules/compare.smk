rule compare_model:
    input:
        model=at("models/{sample}.model.npz"),
        sample=at("samples/{sample}.sample.npz"),
    output:
        numbers=at("fidelity/{sample}.model.json"),
        picture=report(
            at("fidelity/{sample}.model.png"),
            caption="../report/errors.rst",
            category="Fidelity",
            labels={"sample": "{sample}", "what": "errors of the Model"},
        ),
    log:
        at("logs/compare_model/{sample}.log"),
    benchmark:
        at("benchmarks/compare_model/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(2000),
        memory=MEMORY,
    params:
        code=code("metrics", "compression", "cli/compare.py"),
    message:
        "comparing the Model of {wildcards.sample} with its Sample"
    shell:
        "btfpipe compare {input.model:q} {input.sample:q} --picture {output.picture:q}"
        " --threads {threads} {resources.memory} --out {output.numbers:q} --quiet 2> {log:q}"


rule compare_truth:
    input:
        appearance=lambda wildcards: at(
            "models/{sample}.model.npz"
            if wildcards.what == "model"
            else "samples/{sample}.sample.npz"
        ),
        truth=at("samples/{sample}.truth.npz"),
    output:
        numbers=at("fidelity/{sample}.{what}-at-truth.json"),
    log:
        at("logs/compare_truth/{sample}.{what}.log"),
    benchmark:
        at("benchmarks/compare_truth/{sample}.{what}.jsonl")
    wildcard_constraints:
        what="model|sample",
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(2000),
        memory=MEMORY,
    params:
        code=code("metrics", "compression", "cli/compare.py"),
    message:
        "comparing the {wildcards.what} of {wildcards.sample} with the truth between its directions"
    shell:
        "btfpipe compare {input.appearance:q} {input.truth:q} --interpolation all"
        " --threads {threads} {resources.memory} --out {output.numbers:q} --quiet 2> {log:q}"


rule fidelity:
    input:
        models=expand(at("fidelity/{sample}.model.json"), sample=config["samples"]),
        truth=expand(
            at("fidelity/{sample}.{what}-at-truth.json"),
            sample=TRUE_SAMPLES,
            what=["sample", "model"],
        ),
    output:
        table=at("fidelity.md"),
        page=report(
            at("fidelity.html"),
            caption="../report/fidelity.rst",
            category="Fidelity",
            labels={"sample": "all", "what": "table of errors"},
        ),
    log:
        at("logs/fidelity.log"),
    benchmark:
        at("benchmarks/fidelity.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    message:
        "gathering the errors into one table"
    script:
        "../scripts/fidelity_table.py"
