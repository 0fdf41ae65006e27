// SPDX-License-Identifier: Apache-2.0
//
// Exceptions.

#ifndef SHMMAP_ERRORS_HPP
#define SHMMAP_ERRORS_HPP

#include <stdexcept>
#include <string>
#include <utility>

namespace shmmap {

/// An error: `what()` describes it, `code()` is its name in the protocol and in Python, and `hint()` is a remedy,
/// if one is known.
class Error : public std::runtime_error {
 public:
  Error(std::string code, const std::string& message, std::string hint = "")
      : std::runtime_error(hint.empty() ? message : message + " (" + hint + ")"),
        code_(std::move(code)),
        hint_(std::move(hint)) {}
  [[nodiscard]] const std::string& code() const noexcept { return code_; }
  [[nodiscard]] const std::string& hint() const noexcept { return hint_; }

 private:
  std::string code_, hint_;
};

/// The request is invalid, also if it is repeated.
struct BadRequest : Error { using Error::Error; };
/// There is no such column.
struct NoColumn : BadRequest { using BadRequest::BadRequest; };
/// No answer: `no_socket`, `no_permission`, `stale_socket`, `connection_lost` or `no_answer`.
struct Unreachable : Error { using Error::Error; };
/// `Options::keep_waiting` ended a wait (`interrupted`).
struct Interrupted : Error { using Error::Error; };
/// The peer speaks another version of the protocol, or is not shmmap.
struct ProtocolMismatch : Error { using Error::Error; };
/// The daemon refused: any other code.
struct Refused : Error { using Error::Error; };
/// A segment differs from its handle: `segment_corrupt`, or `stale_handle` if it was removed.
struct SegmentError : Error { using Error::Error; };

}  // namespace shmmap

#endif  // SHMMAP_ERRORS_HPP
