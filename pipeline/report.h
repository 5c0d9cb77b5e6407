// The report on a workspace: what came out of a capture, how good it is, what was left out and why.
//
// Written from the artifacts' manifests and payloads and from the stages' records (workspace.h), whatever of them is
// there: a capture that failed gets a report, too, with the diagnosis and everything that was made before.
//
//   report.html   one self-contained page: no other file, no network
//   summary.json  the same figures for programs (schema 1). What is not known is null; arrays are then empty.
//     name, status        "complete" | "failed" | "incomplete" (later stages have not run)
//     failure             null | {stage, error}
//     metrics             {psnr (dB), ssim, lpips, n_images, lpips_reason, and <figure>_reason where a figure is null}
//     images              [{name, rendered, truth, error, psnr, ssim, lpips, identical?, ssim_reason?}]; paths relative
//                         to the workspace; psnr null and identical true: the image equals its photo
//     split               {rule, train, test: photos set apart by ingest; registered: photos with a pose;
//                          registered_train, registered_test}
//     decisions           [{stage, feature, needed, evidence, threshold, reason}]
//     stages              [{name, seconds, peak_memory_bytes, reused: taken as it was in the last run}]
//     total_seconds       sum over the stages, whichever run they were made in
//     training            {steps, samples, seconds, preset, device, threads, n_parameters, model_bytes,
//                          curve [{seconds, steps, samples, psnr, train_psnr}]}
//     settings            {options: {stage: {option: value as given}}, training: every setting of the model}
//     protocol            how the metrics were made (eval/evaluate.h), or null
//     warnings            [{kind, text, items: [text]}] what a reader of the figures has to know
//     versions            {nrff, colmap}; a stage made by another version of nrff has its own entry
//     host                {cpu, cores, memory_bytes, os} where training ran, or ingest if it has not
#pragma once

#include <filesystem>
#include <vector>

namespace nrff {

// Makes the artifact WORKSPACE/report. Throws ResourceError when it cannot be written; what is missing or damaged in
// the workspace is shown, not thrown.
void WriteReport(const std::filesystem::path& workspace);

// Writes FOLDER/report/report.html and summary.json {schema_version, captures: [{workspace, report, name, status,
// failure, metrics, split, training_seconds, total_seconds, model_bytes, device}]}: one row per workspace, from what
// lies on disk there. Paths are relative to FOLDER.
void WriteJointReport(const std::filesystem::path& folder, const std::vector<std::filesystem::path>& workspaces);

}  // namespace nrff
