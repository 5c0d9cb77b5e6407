#include "sfm/pieces.h"

#include <algorithm>
#include <map>
#include <optional>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr size_t kNamedRanges = 6;

std::string Count(size_t n, const char* what) { return std::to_string(n) + " " + what + (n == 1 ? "" : "s"); }

std::string NameOf(const Capture& capture, int photo) { return EscapePath(capture.images[size_t(photo)].path); }

// The group of each photo, −1 for none.
std::vector<int> PieceOfPhotos(const Pieces& pieces, size_t n_photos) {
  std::vector<int> piece_of(n_photos, -1);
  for (size_t k = 0; k < pieces.pieces.size(); ++k) {
    for (const int photo : pieces.pieces[k].photos) piece_of[size_t(photo)] = int(k);
  }
  return piece_of;
}

// The folders below the capture that hold one group each and nothing else; nothing where it is not so.
std::optional<std::vector<fs::path>> FoldersOfPieces(const Capture& capture, const Pieces& pieces) {
  std::vector<fs::path> folders;
  for (const Piece& piece : pieces.pieces) {
    const fs::path folder = capture.images[size_t(piece.photos.front())].path.parent_path();
    const auto in_folder = [&](int photo) {
      const CaptureImage& image = capture.images[size_t(photo)];
      return !image.extracted && image.path.parent_path() == folder;  // frames lie elsewhere
    };
    if (folder.empty() || std::find(folders.begin(), folders.end(), folder) != folders.end() ||
        !std::all_of(piece.photos.begin(), piece.photos.end(), in_folder))
      return {};
    folders.push_back(folder);
  }
  return folders;
}

// Where photos in between would help: the pair that matches best, else neighbours in the order of taking.
std::optional<std::pair<int, int>> Gap(const Capture& capture, const Pieces& pieces) {
  if (pieces.most_matches > 0) return pieces.closest;
  if (!capture.ordered) return {};
  const std::vector<int> piece_of = PieceOfPhotos(pieces, capture.images.size());
  for (size_t i = 0, last = piece_of.size(); i < piece_of.size(); ++i) {
    if (piece_of[i] < 0) continue;
    if (last < i && piece_of[last] != piece_of[i]) return std::pair(int(last), int(i));
    last = i;
  }
  return {};
}

}  // namespace

int Pieces::NumPlaced() const {
  size_t n = 0;
  for (const Piece& piece : pieces) n += piece.photos.size();
  return int(n);
}

Pieces FindPieces(const Capture& capture, const ColmapDatabase& database, const std::vector<ColmapModel>& models) {
  std::vector<const ColmapModel*> by_size;
  by_size.reserve(models.size());
  for (const ColmapModel& model : models) by_size.push_back(&model);
  std::stable_sort(by_size.begin(), by_size.end(), [](const auto* a, const auto* b) {
    return std::pair(a->images.size(), a->points.size()) > std::pair(b->images.size(), b->points.size());
  });
  std::map<std::string, int> index_of;
  for (size_t i = 0; i < capture.images.size(); ++i) index_of[WorkingPhotoName(capture.images[i])] = int(i);
  Pieces pieces;
  std::set<int> placed;
  for (const ColmapModel* model : by_size) {
    Piece piece;
    for (const auto& [id, image] : model->images) {
      const auto photo = index_of.find(image.name);
      if (photo != index_of.end() && !placed.contains(photo->second)) piece.photos.push_back(photo->second);
    }
    if (piece.photos.size() < kLeastPiece) continue;
    std::sort(piece.photos.begin(), piece.photos.end());
    piece.n_points = model->points.size();
    placed.insert(piece.photos.begin(), piece.photos.end());
    pieces.pieces.push_back(std::move(piece));
  }
  std::stable_sort(pieces.pieces.begin(), pieces.pieces.end(),
                   [](const Piece& a, const Piece& b) { return a.photos.size() > b.photos.size(); });
  const std::vector<int> piece_of = PieceOfPhotos(pieces, capture.images.size());
  for (size_t i = 0; i < piece_of.size(); ++i) {
    if (piece_of[i] < 0) pieces.elsewhere.push_back(int(i));
  }
  std::map<uint32_t, int> photo_of;
  for (const auto& [id, image] : database.images) {
    const auto photo = index_of.find(image.name);
    if (photo != index_of.end()) photo_of[id] = photo->second;
  }
  for (const auto& [ids, n] : database.verified_matches) {
    const auto a = photo_of.find(ids.first), b = photo_of.find(ids.second);
    if (a == photo_of.end() || b == photo_of.end()) continue;
    const int piece_a = piece_of[size_t(a->second)], piece_b = piece_of[size_t(b->second)];
    if (piece_a < 0 || piece_b < 0 || piece_a == piece_b) continue;
    ++pieces.n_pairs;
    pieces.n_holding += n >= kHoldingMatches ? 1 : 0;
    if (n > pieces.most_matches) {
      pieces.most_matches = n;
      pieces.closest = std::minmax(a->second, b->second);
    }
  }
  return pieces;
}

std::string PhotoRanges(const Capture& capture, const std::vector<int>& photos) {
  std::string text;
  size_t n_ranges = 0;
  for (size_t i = 0; i < photos.size(); ++n_ranges) {
    if (n_ranges == kNamedRanges) return text + " and " + std::to_string(photos.size() - i) + " more";
    size_t end = i + 1;
    while (end < photos.size() && photos[end] == photos[end - 1] + 1) ++end;
    if (end - i == 2) --end;  // two are named as they are
    text += (text.empty() ? "" : ", ") + NameOf(capture, photos[i]);
    if (end - i > 1) text += " to " + NameOf(capture, photos[end - 1]);
    i = end;
  }
  return text;
}

std::string DescribePieces(const Capture& capture, const Pieces& pieces) {
  std::string text = "the photos fall into " + std::to_string(pieces.pieces.size()) + " groups: ";
  for (size_t k = 0; k < pieces.pieces.size(); ++k) {
    const Piece& piece = pieces.pieces[k];
    text += (k == 0 ? "" : "; ") + Count(piece.photos.size(), "photo") + " with " + Count(piece.n_points, "point") +
            " (" + PhotoRanges(capture, piece.photos) + ")";
  }
  if (!pieces.elsewhere.empty()) {
    text +=
        "; " + Count(pieces.elsewhere.size(), "photo") + " in none (" + PhotoRanges(capture, pieces.elsewhere) + ")";
  }
  return text;
}

std::string AdviseOnPieces(const Capture& capture, const Pieces& pieces, const fs::path& lists) {
  std::string text;
  const std::string tried = "of " + std::to_string(pieces.n_pairs) + " pairs tried";
  if (pieces.most_matches == 0) {
    text = "No photo of one group matches any of another (" + tried + ")";
  } else {
    const std::string best = std::to_string(pieces.most_matches) + " matches, " +
                             NameOf(capture, pieces.closest.first) + " and " + NameOf(capture, pieces.closest.second);
    text =
        "Between groups, " +
        (pieces.n_holding == 0 ? "no pair has the " + std::to_string(kHoldingMatches) + " matches that could hold (" +
                                     tried + "; the most, " + best + ", can be chance)"
                               : Count(size_t(pieces.n_holding), "pair") + " " + tried + " may hold (the most, " +
                                     best + "), too few to join them");
  }
  text += ". If they show different scenes, run each by itself";
  if (const auto folders = FoldersOfPieces(capture, pieces)) {
    for (size_t k = 0; k < folders->size(); ++k)
      text += (k == 0 ? ": " : ", ") + std::string("nrff run ") + EscapePath(capture.root / (*folders)[k]);
  } else {
    text += ", from a folder of its own (" + EscapePath(lists / "1.txt") + " and so on list the photos)";
  }
  text += "; if they show one scene, add photos that lead from one group to another";
  if (const auto gap = Gap(capture, pieces))
    text += ", as between " + NameOf(capture, gap->first) + " and " + NameOf(capture, gap->second);
  return text;
}

Json PiecesJson(const Capture& capture, const Pieces& pieces) {
  Json json = Json::array();
  for (const Piece& piece : pieces.pieces) {
    json.push_back({{"n_images", piece.photos.size()},
                    {"n_points", piece.n_points},
                    {"photos", PhotoRanges(capture, piece.photos)}});
  }
  return json;
}

void WritePieceLists(const Capture& capture, const Pieces& pieces, const fs::path& dir) {
  fs::remove_all(dir);
  fs::create_directories(dir);
  for (size_t k = 0; k < pieces.pieces.size(); ++k) {
    std::string list;
    for (const int photo : pieces.pieces[k].photos) list += NameOf(capture, photo) + "\n";
    WriteFileAtomically(dir / (std::to_string(k + 1) + ".txt"), list);
  }
}

}  // namespace nrff
