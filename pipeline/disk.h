// What the graph asks of the disk. An interface, so that the graph is tested with a disk that is a map in memory.
#pragma once

#include <filesystem>
#include <optional>
#include <string>

#include "pipeline/manifest.h"

namespace nrff {

struct ArtifactState {
  std::optional<Manifest> manifest;  // present only when the artifact is whole
  std::string problem;               // otherwise why it is not, to be read after the stage's name: "has not been made"
};

class Disk {
 public:
  virtual ~Disk() = default;
  // Throws CorruptError when a newer program made the artifact: running the stage again would destroy it.
  virtual ArtifactState ReadArtifact(const std::filesystem::path& artifact) = 0;
  // Throws InputError when `source` cannot be read.
  virtual std::string HashSource(const std::filesystem::path& source) = 0;
};

// A damaged manifest, or one that names payload files which are missing or of another size, counts as no artifact.
class RealDisk : public Disk {
 public:
  ArtifactState ReadArtifact(const std::filesystem::path& artifact) override;
  std::string HashSource(const std::filesystem::path& source) override;
};

}  // namespace nrff
